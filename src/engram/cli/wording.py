"""What `map` and `localise` print: frame outcomes and the suggested next command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from shlex import quote
from typing import Any

from engram.counts import counted

# A drive is known, or its area new, from these shares of localised frames on.
_KNOWN, _NEW = 0.9, 0.1

_FATES = {
    "localised": "localised",
    "dead_reckoning": "dead reckoning",
    "lost": "lost",
    "no_odometry": "no odometry",
}


def mapped_text(report: Mapping[str, Any], map_path: Path | str) -> str:
    """What `engram map` prints of the values that ``--json`` prints."""
    if report["known"]:
        return (
            f"nothing to do: the map already contains this drive (session {report['session']}). "
            f"To change its zone, start or robot: engram amend {typed(map_path)} "
            f"{report['session'][:8]}. A drive is identified by its first frame: to map frames "
            "that were left out, start after it with --frames"
        )
    share, saved = report["share_localised"], report["nodes_saved"]
    area = "new area" if share <= _NEW else "partly new area"
    if share >= _KNOWN:
        area = "known area that looks different" if saved else "known area"
    head = f"{area}: {counted(saved, 'node')} saved"
    if report["resumed"]:
        head = f"resumed; {head}"
    if report["revision"] is not None:
        head += f", revision {report['revision']}"
    lines = [head, *_frames(report)]
    if share <= _NEW and saved:
        lines.append("  (in a new area there is nothing to localise in: lost frames are expected)")
    if report["interrupted"]:
        return _lines(*lines, "interrupted: what was done is saved; the same command resumes it")
    return _lines(*lines, f"next: {_after_mapping(report, map_path)}")


def localised_text(
    summary: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], map_path: Path | str
) -> str:
    """What `engram localise` prints of the values that ``--json`` prints."""
    lines = [
        f"{counted(summary['frames'], 'frame')} over {summary['driven_m']:.1f} m: "
        f"{summary['share_localised']:.1%} localised, "
        f"{summary['attempts_per_frame']:.2f} attempts per frame",
        *_frames(summary),
        f"  longest stretch without a match {summary['longest_gap_m']:.1f} m"
        + (f"; {counted(summary['late_frames'], 'frame')} late" if summary["late_frames"] else ""),
        *_stages(summary["stages_ms"]),
    ]
    if _is_elsewhere(summary):
        lines.append("  nothing in this drive looks like the map: is it of the same place?")
    return _lines(*lines, f"next: {_after_localising(summary, frames, map_path)}")


def undo_text(map_path: Path | str, *revisions: int) -> str:
    """The commands that undo revisions, in this order; "" if there are none."""
    return "\n".join(f"to undo: engram revert {typed(map_path)} {number}" for number in revisions)


def typed(path: Path | str) -> str:
    """A path as it is typed in a command."""
    return quote(f"./{path}" if str(path).startswith("-") else str(path))


def _lines(*lines: str) -> str:
    return "\n".join(lines)


def _frames(summary: Mapping[str, Any]) -> list[str]:
    """Outcomes of the frames."""
    statuses = summary["statuses"]
    fates = [f"{statuses.get(status, 0)} {words}" for status, words in _FATES.items()]
    if withdrawn := summary.get("withdrawn", 0):
        fates[0] += f" ({withdrawn} of them withdrawn)"
    if unusable := summary.get("unusable_frames", 0):
        fates.append(f"{unusable} of them unusable")
    if skipped := summary["skipped_pairs"]:
        fates.append(f"{counted(skipped, 'bad pair')} skipped")
    if wrong := summary.get("wrong_stamps", 0):
        fates.append(f"{wrong} left out for their stamps")
    return [f"  {counted(summary['frames'], 'frame')}: {', '.join(fates)}"]


def warnings(summary: Mapping[str, Any]) -> list[str]:
    """What people should look into before they trust a summary; for stderr."""
    from engram.doctor.table import measure_text

    lines = []
    if damaged := summary["damaged_nodes"]:
        lines.append(
            f"warning: {counted(len(damaged), 'damaged node')} of the map "
            f"{'was' if len(damaged) == 1 else 'were'} skipped, such as {damaged[0]}; "
            "engram check lists them"
        )
    for one in summary["findings"]:
        if one["severity"] != "note":
            measured = measure_text(one["value"], one["limit"], one["unit"])
            lines.append(f"warning: {one['code']}: {one['message']} ({measured}). {one['cure']}")
    return lines


def _stages(stages_ms: Mapping[str, Mapping[str, float]]) -> list[str]:
    if "total" not in stages_ms:
        return []
    parts = ", ".join(
        f"{stage} {ms['median']:.1f}" for stage, ms in stages_ms.items() if stage != "total"
    )
    total = stages_ms["total"]
    return [f"  {total['median']:.1f} ms per frame (median), {total['p99']:.1f} (p99): {parts}"]


def _after_mapping(report: Mapping[str, Any], map_path: Path | str) -> str:
    if any(one["severity"] == "fatal" for one in report["findings"]):
        return f"correct the drive, then engram revert {typed(map_path)} {report['revision']}"
    return f"engram localise {typed(map_path)} ANOTHER_DRIVE, or {_shown(map_path)}"


def _shown(map_path: Path | str) -> str:
    """The command that shows a map: a picture, where what draws it is installed."""
    if find_spec("matplotlib") is None:
        return f"engram info {typed(map_path)}"
    return f"engram plot {typed(map_path)} map.png"


def _fatal(summary: Mapping[str, Any]) -> list[str]:
    return [one["code"] for one in summary["findings"] if one["severity"] == "fatal"]


def _is_elsewhere(summary: Mapping[str, Any]) -> bool:
    """Whether a sound drive was looked for in the whole map, and never found."""
    statuses = summary["statuses"]
    found = statuses.get("localised", 0) or not statuses.get("lost", 0)
    return not found and not _fatal(summary)


def _after_localising(
    summary: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], map_path: Path | str
) -> str:
    if fatal := _fatal(summary):
        return f"correct the drive ({', '.join(fatal)}, see the warnings), then localise it again"
    if _is_elsewhere(summary):
        return (
            "if it is the same place in other light or weather, map it, too: engram map "
            f"{typed(map_path)} DRIVE"
        )
    if (frame := unmatched(frames)) is not None:
        return f"engram localise {typed(map_path)} DRIVE --explain {frame}"
    return _shown(map_path)


def unmatched(frames: Sequence[Mapping[str, Any]]) -> int | None:
    """The middle one of the frames that no node matched; None if there is none."""
    missed = [
        number
        for number, frame in enumerate(frames)
        if frame["status"] in {"dead_reckoning", "lost"}
    ]
    return missed[len(missed) // 2] if missed else None
