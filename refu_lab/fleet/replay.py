"""Replays many recordings: each is a task, and one that is finished isn't run again."""

from __future__ import annotations

import hashlib
import json
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from msg_adapters.bags import LIBRARY
from refu_core import GarmentPipeline, RefuError, __version__
from refu_core._cache import code_hash
from refu_core._engine import Engine, Lost
from refu_core.errors import printable
from refu_core.garments import garment_files
from refu_lab.commands.replay import ReplayOptions
from refu_lab.fleet._engine import run_function
from refu_lab.fleet._inputs import Input
from refu_lab.fleet._storage import Folder, fetched, filesystem, is_url
from refu_lab.fleet._summary import FleetResult
from refu_lab.replay import ReplayResult, replay
from refu_lab.sources import open_source

WORST = 5
"""Number of a recording's worst frames that are listed in its record."""
_NOT_CONTENT = ("input", "output", "overwrite", "speed")
"""Options that results don't depend on, or only through the content of what is read."""
_CODE = (
    "refu_core/**/*.py",
    "refu_core/assets/*.npz",
    "refu_core/weights/**/*.json",
    "refu_core/weights/**/*.safetensors",
    "msg_adapters/**/*.py",
    "refu_lab/*.py",
)
"""Files of the project that results depend on, without the bytecode that Python compiles from them."""


@dataclass(frozen=True, kw_only=True)
class FleetOptions:
    """How recordings are replayed, and where their results go."""

    replay: ReplayOptions
    """How each one is replayed; its input and output are ignored."""
    output: str | None = None
    """Folder or URL of the bags: NAME.mcap."""
    report: str | None = None
    """Folder or URL of the reports: index.html for all together, NAME/index.html for each."""
    again: bool = False
    """Whether finished recordings are replayed again."""

    @property
    def records(self) -> str | None:
        """Folder of the records, NAME.json: a recording that has one is finished."""
        return self.output or self.report


def replay_fleet(
    recordings: list[Input], options: FleetOptions, *, engine: Engine, progress: bool = False
) -> FleetResult:
    """Replays the recordings that aren't finished; the row of one that can't be replayed says why.

    An interrupt (Ctrl-C) ends the run early: what is finished is kept and returned. Raises `RefuError`: options that
    make no pipeline, a folder that can't be written or that another run writes to, or an engine that can't be reached.
    """
    pipeline_for(options.replay)  # options that fail for every recording are reported once, and now
    result = FleetResult(is_kept=options.records is not None)
    rows: dict[int, dict[str, Any]] = {}
    with ExitStack() as stack:
        for place in dict.fromkeys((options.output, options.report)):
            if place is not None:
                stack.enter_context(Folder(place).locked())
        bar = stack.enter_context(tqdm(total=len(recordings), unit="recording", disable=None if progress else True))
        try:
            for index, row in engine.run(run_function(partial(_replay_one, options)), recordings):
                lost = {"error": row.reason} if isinstance(row, Lost) else row
                rows[index] = {"name": recordings[index].name, "input": recordings[index].source, **lost}
                bar.update()
        except KeyboardInterrupt:
            result.interrupted = True
        result.rows = [rows[index] for index in sorted(rows)]
        result.n_left = len(recordings) - len(rows)
        if options.report is not None:
            Folder(options.report).put_text(result.page(), "index.html")
    return result


def _replay_one(options: FleetOptions, recording: Input) -> dict[str, Any]:
    """A recording's record, existing or new; if it can't be replayed, the record is the error."""
    try:
        with fetched(recording.source) as path:
            return _finished_or_new(options, recording, path)
    except RefuError as error:
        return {"error": str(error)}
    except (OSError, UnicodeError, MemoryError, RecursionError) as error:
        return {"error": printable(str(error) or type(error).__name__)}


def _finished_or_new(options: FleetOptions, recording: Input, path: Path) -> dict[str, Any]:
    key, name = _key(options, recording, path), recording.name
    records = None if options.records is None else Folder(options.records)
    if records is not None and not options.again:
        known = records.read_json(f"{name}.json")
        if not isinstance(known, dict) or "key" not in known:
            _require_free(options, name, records)
        elif known["key"] == key and known.get("hash") == _record_hash(known) and _is_there(known, options, name):
            return known | {"kept": True}
    record = {"key": key, **_make(options, recording, path)}
    if records is not None:
        whole = record | {"hash": _record_hash(record)}
        records.put_text(json.dumps(whole, indent=1, allow_nan=False) + "\n", f"{name}.json")
    return record


def _record_hash(record: dict[str, Any]) -> str:
    """Tells a record that was damaged, and so is worth nothing, whatever it says."""
    return _hash_of({name: value for name, value in record.items() if name != "hash"})


def _require_free(options: FleetOptions, name: str, records: Folder) -> None:
    """Raises `RefuError` where a recording without a record would write over anything but results of `refu replay`.

    A run that was killed leaves results without a record.
    """
    taken = {records.at(f"{name}.json"): records.size(f"{name}.json") is not None}
    if options.output is not None:
        start = Folder(options.output).start(f"{name}.mcap")
        taken[Folder(options.output).at(f"{name}.mcap")] = start is not None and LIBRARY.encode() not in start
    if options.report is not None:
        folder = Folder(options.report)
        taken[folder.at(name)] = folder.size(name) is not None and folder.size(f"{name}/index.html") is None
    for place in (place for place, is_taken in taken.items() if is_taken):
        msg = f"{place}: is there already, and no result of refu replay; choose another folder, or --overwrite it"
        raise RefuError(msg)


def _is_there(record: dict[str, Any], options: FleetOptions, name: str) -> bool:
    if options.output is not None and Folder(options.output).size(f"{name}.mcap") != record.get("output_bytes", -1):
        return False
    return options.report is None or Folder(options.report).size(f"{name}/index.html") is not None


def _make(options: FleetOptions, recording: Input, path: Path) -> dict[str, Any]:
    name = recording.name
    told: dict[str, Any] = {"input": recording.source, "output": None, "output_bytes": None}
    output = None if options.output is None else Folder(options.output)
    with nullcontext() if output is None else output.scratch() as own:
        bag = None if own is None else own / f"{name}.mcap"  # a bag contains its own name
        asked = replace(options.replay, input=path, output=bag)
        result = replay(asked, source=open_source(asked, pipeline_for(options.replay)))
        if result.interrupted:  # a record is of a whole recording
            raise KeyboardInterrupt
        if output is not None and bag is not None:
            told |= {"output": output.at(f"{name}.mcap"), "output_bytes": bag.stat().st_size}
            output.put(bag, f"{name}.mcap")
    if options.report is not None and result.frames:
        from refu_lab.report import write_report

        folder = Folder(options.report)
        with folder.scratch() as scratch:
            write_report(result, scratch / name)
            folder.put(scratch / name, name)
    return result.as_dict() | _over_all(result) | told


_loaded: dict[str, GarmentPipeline] = {}
"""This process's pipelines by the content of their options; at most two, which may take turns."""


def pipeline_for(options: ReplayOptions) -> GarmentPipeline:
    """This process's pipeline for these options, kept since loading one takes long. Raises as `load_pipeline`."""
    content = _content(options)
    if content not in _loaded:
        for oldest in [*_loaded][:-1]:
            del _loaded[oldest]
        _loaded[content] = options.load_pipeline()
    return _loaded[content]


def _over_all(result: ReplayResult) -> dict[str, Any]:
    """A recording's figures over all garments, and its worst frames."""
    if not result.frames:
        return {"free_percent": None, "vfcp_percent": None, "max_depth_mm": None, "worst": []}
    left = [frame.total("after") for frame in result.frames]
    n_free = sum(not (one.n_inside or one.n_pairs) for one in left)
    shares = [one.vfcp_percent for one in result.after.values() if one.vfcp_percent is not None]
    stamps = [one.frame.stamp_ns for one in result.frames]
    worst = []
    for i in sorted(range(len(left)), key=lambda i: result.frames[i].badness, reverse=True)[:WORST]:
        when: dict[str, Any] = {"frame": i, "time_s": 1e-9 * (stamps[i] - stamps[0]), "stamp_ns": stamps[i]}
        found = {"n_inside": left[i].n_inside, "n_pairs": left[i].n_pairs, "max_depth_mm": 1e3 * left[i].max_depth}
        worst.append({**when, **found, "badness": [float(x) for x in result.frames[i].badness]})
    return {
        "free_percent": 100 * n_free / len(left),
        "vfcp_percent": sum(shares) / len(shares) if shares else None,
        "max_depth_mm": max((one.max_depth_mm or 0.0) for one in result.after.values()),
        "worst": worst,
    }


def _key(options: FleetOptions, recording: Input, path: Path) -> str:
    """Hash of the recording, of how it is replayed, and of the code and weights."""
    read = (recording.name, _recording_hash(recording.source, path))
    told = (__version__, code_hash(*_CODE), *read, _content(options.replay))
    return _hash_of(told)


def _hash_of(values: Any) -> str:
    """Hash of plain values, as JSON has them."""
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def _content(options: ReplayOptions) -> str:
    """The options that results depend on, as text; what a garment's name and a folder of weights stand for, too."""
    names = [option.name for option in fields(options) if option.name not in _NOT_CONTENT]
    known = garment_files()
    files = [known[name] for name in options.garments if name in known]
    files += [Path(options.weights)] if options.weights else []
    return json.dumps({name: _told(getattr(options, name)) for name in names} | {"files": _told(files)})


def _told(value: Any) -> Any:
    """An option's value by its content: files and folders by a hash of what is in them."""
    if isinstance(value, (list, tuple)):
        return [_told(one) for one in value]
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).is_file()):
        return _tree_hash(Path(value)) if Path(value).exists() else str(value)
    return value if value is None or isinstance(value, (bool, int, float)) else str(value)


def _recording_hash(source: str, path: Path) -> str:
    if is_url(source):
        fs, there = filesystem(source)
        if not fs.isdir(there):
            return str(fs.ukey(there))  # the store's version of the file, without reading it again
    return _tree_hash(path)


def _tree_hash(path: Path) -> str:
    """Hash of a file, or of a folder's files and their names; that of nothing if there is none."""
    digest = hashlib.sha256()
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    for file in (one for one in files if one.is_file()):
        digest.update(b"" if file == path else file.relative_to(path).as_posix().encode() + b"\0")
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
