"""The bag that a replay writes: the input messages, the garments, the body that wears them, and diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msg_adapters as adapters
from msg_adapters import FrameRecord
from msg_adapters.diagnostics import ERROR, OK, WARN
from msg_adapters.markers import SKIN
from msg_adapters.people import MAX_STAMP_NS
from refu_core import GarmentPipeline, SmplFrame
from refu_core.realtime import PipelineOutput
from refu_lab.commands.replay import ReplayOptions
from refu_lab.interrupts import undisturbed
from refu_lab.sources import Source

if TYPE_CHECKING:
    from refu_lab.replay import GarmentRecord

GARMENTS_TOPIC, BODY_TOPIC, DIAGNOSTICS_TOPIC = "/garments", "/body", "/diagnostics"


def garment_meshes(pipeline: GarmentPipeline, person: str = "") -> list[adapters.MarkerMesh]:
    """The pipeline's garments as markers, in their order, each in its own colour."""
    return [
        adapters.MarkerMesh(
            ns=adapters.garment_namespace(name, person),
            faces=garment.faces.cpu().numpy(),
            n_vertices=garment.n_vertices,
            color=(*garment.card.color, 1.0),
        )
        for name, garment in pipeline.garments.items()
    ]


class DressedBag:
    """Writes the topics of the node, without the node: a viewer that shows the node shows this bag, too.

    Diagnostics hold no measured times, so that replaying again writes the same bag.

    Raises `BagError` when `options.output` can't be written.
    """

    def __init__(self, options: ReplayOptions, pipeline: GarmentPipeline, source: Source) -> None:
        assert options.output is not None
        self._source = source
        self._skipped = 0
        self._is_empty = True
        self._settings = {"sdf": str(options.sdf), "backbone": str(options.backbone)}
        self._writer = adapters.BagWriter(options.output, overwrite=options.overwrite, in_background=True)
        given = None if source.bag is None else source.bag.topic
        own: dict[str, Any] = {}
        if given is not None:
            own = {"definition": given.definition or None, "type_hash": given.type_hash, "betas_of": given.betas_of}
        self._writer.add_topic(source.topic, source.message_type, **own)
        self._writer.add_topic(GARMENTS_TOPIC, adapters.MARKER_ARRAY)
        self._writer.add_topic(DIAGNOSTICS_TOPIC, adapters.DIAGNOSTIC_ARRAY)
        self._body: adapters.MarkerArrayEncoder | None = None
        if options.with_body:
            self._writer.add_topic(BODY_TOPIC, adapters.MARKER_ARRAY)
            faces = pipeline.body.faces.cpu().numpy()
            mesh = adapters.MarkerMesh("body", faces, len(pipeline.body.v_template), color=SKIN)
            self._body = adapters.MarkerArrayEncoder([mesh], frame_id=options.frame_id, axes=options.axes)

    def __enter__(self) -> DressedBag:
        return self

    def __exit__(self, *error: Any) -> None:
        """Finishes the bag, also after an exception; removes a bag without a frame."""
        with undisturbed():
            if self._is_empty:
                self._writer.discard()
            self._writer.__exit__(*error)

    @undisturbed()
    def add_skip(self, record: FrameRecord, reason: str) -> None:
        """Writes a message as it came, and why it was not replayed."""
        self._skipped += 1
        self._add_input(record)
        stamp_ns = min(record.stamp_ns, MAX_STAMP_NS - 1)  # the stamp may be the reason
        self._say(record, stamp_ns, [self._input(ERROR, reason)])

    @undisturbed()
    def add_frame(
        self,
        record: FrameRecord,
        frame: SmplFrame,
        output: PipelineOutput,
        garments: bytes,
        exact: Mapping[str, GarmentRecord] | None,
    ) -> None:
        """Writes a message as it came, its encoded garments, and what exact checks found, if there were any."""
        self._is_empty = False
        self._add_input(record)
        self._writer.write(GARMENTS_TOPIC, garments, log_time_ns=record.log_time_ns)
        if self._body is not None:
            data = self._body.encode([output.body], stamp_ns=frame.stamp_ns, transl=frame.transl)
            self._writer.write(BODY_TOPIC, data, log_time_ns=record.log_time_ns)
        found = [self._garment(name, output, None if exact is None else exact[name]) for name in output]
        self._say(record, frame.stamp_ns, [self._input(OK, self._source.topic), *found])

    def _add_input(self, record: FrameRecord) -> None:
        if record.raw or self._source.bag is not None:
            self._writer.write(self._source.topic, record.raw, log_time_ns=record.log_time_ns)

    def _say(self, record: FrameRecord, stamp_ns: int, statuses: list[adapters.DiagnosticStatus]) -> None:
        data = adapters.encode_diagnostics(statuses, stamp_ns=stamp_ns)
        self._writer.write(DIAGNOSTICS_TOPIC, data, log_time_ns=record.log_time_ns)

    def _input(self, level: int, message: str) -> adapters.DiagnosticStatus:
        values = {"input type": self._source.message_type, "skipped": str(self._skipped)}
        return adapters.DiagnosticStatus(level, "refu replay: input", message, values=values)

    def _garment(self, name: str, output: PipelineOutput, exact: GarmentRecord | None) -> adapters.DiagnosticStatus:
        """A garment's status: by exact checks if the frame was evaluated, else by what collision handling reports."""
        stats = output.stats.garments[name]
        n_inside, n_pairs = (stats.n_unresolved, 0) if exact is None else exact.after[:2]
        values = {
            "vertices inside before": str(stats.n_inside if exact is None else exact.before.n_inside),
            "vertices inside": str(n_inside),
            "vertices that were moved": str(stats.n_pushed),
        }
        if exact is not None:
            values |= {
                "intersecting pairs of triangles before": str(exact.before.n_pairs),
                "intersecting pairs of triangles": str(n_pairs),
                "deepest before [mm]": f"{1e3 * exact.before.max_depth:.1f}",
                "deepest [mm]": f"{1e3 * exact.after.max_depth:.1f}",
            }
        values |= {
            "skin moved by the collider, at most [mm]": f"{1e3 * output.stats.shift.largest:.1f}",
            "skin that gives way no farther [vertices]": str(output.stats.shift.n_held),
            "within the promised poses and shapes": "yes" if output.stats.within_promise else "no",
            **self._settings,
        }
        level, message = OK, "free of collisions"
        if n_inside or n_pairs:
            level, message = WARN, f"{n_inside} vertices inside the body, {n_pairs} pairs of triangles intersect"
        elif exact is None:
            message = "no vertex inside the body" if self._settings["sdf"] != "none" else "not looked at"
        return adapters.DiagnosticStatus(level, f"refu replay: {name}", message, values=values)
