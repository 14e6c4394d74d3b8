"""What a robot wants to know of a dressed person: openings, clearance, contacts, a planner's mesh, and their certainty.

python examples/robot_outputs.py
"""

from __future__ import annotations

import numpy as np

from refu_core import GarmentPipeline, SmplFrame
from refu_core.outputs import Clearance, LimbContacts, Openings, PinholeCamera, PlannerMesh, Sigma, visible


def main() -> None:
    """Prints all of these for one frame."""
    pipeline = GarmentPipeline.load(["short-pant-male"])
    (garment,) = pipeline.garments.values()
    openings, planner = Openings(garment), PlannerMesh.of(pipeline, garment.name)  # once for each garment
    clearance, contacts, sigma = Clearance.of(pipeline), LimbContacts.of(pipeline), Sigma(pipeline)  # once

    pose = np.zeros((24, 3))
    pose[1, 0] = pose[2, 0] = -2.0  # a deep squat
    pose[4, 0] = pose[5, 0] = 2.2
    frame = SmplFrame(pose=pose, transl=[0.0, 0.7, 0.0])
    out = pipeline(frame)
    worn = out[garment.name]

    for opening in openings.frames(worn.vertices):
        centre, normal = opening.centre.round(2), opening.rotation[:, 2].round(2)
        print(f"{opening.name}: at {centre}, opens to {normal}, {1e3 * opening.perimeter:.0f} mm round")
    distance = clearance(out)[garment.name]
    print(f"nearest to the skin: {1e3 * distance.min():.3f} mm; {(distance < 0.01).mean():.0%} within 10 mm")
    for contact in contacts(out):
        print(f"between {contact.parts}: {1e4 * contact.area:.0f} cm², {1e3 * contact.depth:.0f} mm deep")
    solid = planner.solid(worn.vertices)
    print(f"for a planner: {len(planner.faces)} triangles, {len(solid)} vertices")
    camera = PinholeCamera.looking_at(worn.vertices.mean(0), [0.5, 1.2, 2.0])
    seen = visible(worn.vertices, worn.faces, camera, [(out.body + out.transl, pipeline.body.faces)])
    wide = np.tile(np.radians(2.0) ** 2 * np.eye(3), (24, 1, 1))  # a tracker that is wrong by 2° a joint
    found = sigma(frame, out, pose_covariance=wide)[garment.name]
    print(f"seen: {seen.mean():.0%}; sigma {1e3 * found.mean():.1f} mm with what the tracker adds")


if __name__ == "__main__":
    main()
