"""The topics about dressed people: a table of each one's name, its type, and how it is made."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from msg_adapters.diagnostics import DIAGNOSTIC_ARRAY, OK, DiagnosticStatus, encode_diagnostics
from msg_adapters.markers import MARKER_ARRAY, SKIN, MarkerArrayEncoder, MarkerMesh, encode_delete, garment_namespace
from msg_adapters.outputs import _meshes
from msg_adapters.outputs._points import POINT_CLOUD, POINT_FIELDS, PointCloudEncoder
from msg_adapters.outputs._topics import Apart, Layouts, Moment, Obstacles, Output, Together
from msg_adapters.transforms import TF_MESSAGE

if TYPE_CHECKING:
    from refu_core.outputs import DressedPerson, Fittings

GARMENTS, BODY, OPENINGS = "garments", "body", "openings"


def _token(name: str) -> str:
    """A garment's name in a form that topics allow."""
    word = re.sub(r"\W", "_", name, flags=re.ASCII)
    return word if word[:1].isalpha() else f"garment_{word}"


def _mesh_of(one: DressedPerson, name: str) -> MarkerMesh:
    known, ns = one.fittings, garment_namespace(name, one.person)
    return MarkerMesh(ns, known.faces[name], known.counts[name], color=known.colors[name])


def _rims_of(one: DressedPerson) -> list[_meshes.Rim]:
    places = ((garment_namespace(name, one.person), rim) for name, rims in one.openings.items() for rim in rims)
    return [
        _meshes.Rim(f"{ns}/{rim.name}", one.stamp_ns, rim.centre + one.offset, rim.rotation, rim.ring + one.offset)
        for ns, rim in places
    ]


def _markers(
    meshes: Callable[[DressedPerson], list[MarkerMesh]], vertices: Callable[[DressedPerson], list[Any]]
) -> Callable[[Sequence[DressedPerson], Moment, Layouts], bytes]:
    def encode(worn: Sequence[DressedPerson], moment: Moment, layouts: Layouts) -> bytes:
        frame_id, lifetime_ns = moment.frame_id, moment.lifetime_ns

        def make() -> MarkerArrayEncoder:
            every = [mesh for one in worn for mesh in meshes(one)]
            return MarkerArrayEncoder(every, frame_id=frame_id, axes="frame", lifetime_ns=lifetime_ns)

        arrays = [vertices(one) for one in worn]
        key = tuple(one.person for one in worn), frame_id, lifetime_ns
        data: bytes = layouts.get(key, make, n_people=len(worn)).encode(
            [points for own in arrays for points in own],
            stamp_ns=[one.stamp_ns for one, own in zip(worn, arrays, strict=True) for _ in own],
            transl=[one.offset for one, own in zip(worn, arrays, strict=True) for _ in own],
        )
        return data

    return encode


def _delete_markers(names: Sequence[str], moment: Moment) -> bytes:
    return encode_delete(names, stamp_ns=moment.now_ns, frame_id=moment.frame_id)


def _garment_names(one: DressedPerson) -> list[str]:
    return [garment_namespace(name, one.person) for name in one.fittings.names]


def _encode_rims(worn: Sequence[DressedPerson], moment: Moment, _: Layouts) -> bytes:
    rims = [rim for one in worn for rim in _rims_of(one)]
    return _meshes.encode_rims(rims, frame_id=moment.frame_id, lifetime_ns=moment.lifetime_ns)


def _encode_scene(worn: Sequence[DressedPerson], moment: Moment, layouts: Layouts) -> bytes:
    entities = [
        _meshes.Entity(layouts.get((one.person, name), partial(_mesh_of, one, name)), points, one.offset, one.stamp_ns)
        for one in worn
        for name, points in one.vertices.items()
    ]
    return _meshes.encode_scene(entities, frame_id=moment.frame_id, lifetime_ns=moment.lifetime_ns)


def _delete_entities(names: Sequence[str], moment: Moment) -> bytes:
    return _meshes.encode_scene([], deleted=names, stamp_ns=moment.now_ns, frame_id=moment.frame_id)


def _encode_tf(worn: Sequence[DressedPerson], moment: Moment, _: Layouts) -> bytes:
    return _meshes.encode_frames([rim for one in worn for rim in _rims_of(one)], frame_id=moment.frame_id)


def _encode_points(layouts: Layouts, one: DressedPerson, _: Any, moment: Moment) -> bytes:
    fields = [name for name in POINT_FIELDS if name in moment.points_fields and (name != "visible" or one.camera)]
    counts = tuple(len(points) for points in one.vertices.values())
    encoder: PointCloudEncoder = layouts.get(
        (counts, moment.frame_id, tuple(fields)),
        lambda: PointCloudEncoder(counts, frame_id=moment.frame_id, fields=fields),
    )
    ways: dict[str, Callable[[], Any]] = {"normal": one.normals, "clearance": one.clearance}
    ways |= {"sigma": one.sigma, "visible": one.visible}
    values = {name: make() for name, make in ways.items() if name in fields}
    return encoder.encode([*one.vertices.values()], stamp_ns=one.stamp_ns, offset=one.offset, values=values)


def _encode_contacts(one: DressedPerson, _: Any, moment: Moment) -> bytes:
    """One status per pair of parts: geometry, from which no force follows."""
    statuses = []
    for contact in one.contacts():
        x, y, z = one.turned(contact.centre) + one.offset
        numbers = {"area [m2]": contact.area, "depth [m]": contact.depth, "mean depth [m]": contact.mean_depth}
        numbers |= {"x [m]": x, "y [m]": y, "z [m]": z}
        values = {name: f"{value:.6f}" for name, value in numbers.items()}
        text = "cloth pressed between them, by geometry: not a force"
        statuses.append(DiagnosticStatus(OK, " / ".join(contact.parts), text, one.person, values))
    return encode_diagnostics(statuses, stamp_ns=one.stamp_ns, frame_id=moment.frame_id)


def _opening_places(fittings: Fittings) -> Iterator[tuple[str, tuple[str, int]]]:
    for name in fittings.names:
        for i, opening in enumerate(fittings.openings[name].names):
            yield f"{OPENINGS}/{_token(name)}/{opening}", (name, i)


def _encode_polygon(one: DressedPerson, place: tuple[str, int], moment: Moment) -> bytes:
    name, i = place
    ring = one.openings[name][i].ring + one.offset
    return _meshes.encode_polygon(ring, stamp_ns=one.stamp_ns, frame_id=moment.frame_id)


def _encode_mesh(one: DressedPerson, name: str, moment: Moment) -> bytes:  # noqa: ARG001 - a mesh has no header
    vertices, faces = one.solid(name)
    return _meshes.encode_mesh(vertices + one.offset, faces)


def make_outputs(*, tf: bool = False) -> list[Output]:
    """The table, for one sender; with `tf`, openings are also frames on /tf."""
    garments = _markers(
        lambda one: [_mesh_of(one, name) for name in one.fittings.names], lambda one: [*one.vertices.values()]
    )
    body = _markers(
        lambda one: [MarkerMesh(garment_namespace(BODY, one.person), *one.fittings.body, color=SKIN)],
        lambda one: [one.body],
    )
    table: list[Output] = [
        Together(GARMENTS, MARKER_ARRAY, _garment_names, garments, _delete_markers),
        Together(BODY, MARKER_ARRAY, lambda one: [garment_namespace(BODY, one.person)], body, _delete_markers),
        Together(
            OPENINGS, MARKER_ARRAY, lambda one: [rim.name for rim in _rims_of(one)], _encode_rims, _delete_markers
        ),
        Together("scene", _meshes.SCENE_UPDATE, _garment_names, _encode_scene, _delete_entities),
        Apart(POINT_CLOUD, lambda _: [("points", None)], partial(_encode_points, Layouts())),
        Apart(DIAGNOSTIC_ARRAY, lambda _: [("contacts", None)], _encode_contacts),
        Apart(_meshes.POLYGON, _opening_places, _encode_polygon),
        Apart(
            _meshes.MESH, lambda worn: [(f"mesh/{_token(name)}", name) for name in worn.names], _encode_mesh, slow=True
        ),
        Obstacles(),
    ]
    if tf:
        table.append(Together("/tf", TF_MESSAGE, lambda _: (), _encode_tf, _delete_markers))
    return table
