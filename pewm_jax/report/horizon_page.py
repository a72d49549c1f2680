"""The report of long rollouts: metrics as JSON, a page, a strip of images and a video."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.io import atomic
from pewm_jax.report.page import Facts, Figure, Section, TableBlock, Text, render
from pewm_jax.report.pictures import grid, save_png
from pewm_jax.report.table import Cell, Table
from pewm_jax.report.video import encode_h264, small_frames

SHOWN = 8
"""Number of frames of a walk in the strip."""
FRAMES_PER_SECOND = 12
NAMES = {
    "truth": "truth",
    "bound": "its renderer, true voxels",
    "known": "started from a known grid",
    "world": "the world itself",
    "without": "without its voxels",
}
"""Labels of the methods; other worlds are labelled with their run's name."""


def write(
    folder: Path, facts: Mapping[str, Any], videos: Mapping[str, np.ndarray], ends: Sequence[int]
) -> Path:
    """Write the report and return the page's path.

    ``facts`` are plain values: ``psnr`` and optionally ``distances`` by method, ``edits``,
    ``protocol``; ``videos`` are (B, T, H, W, 3) uint8 colours by method, ``truth`` first; ``ends``
    the last frames of the segments.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(folder / "horizon.json") as partial:
        partial.write_text(json.dumps(facts, indent=1) + "\n")
    count = next(iter(videos.values())).shape[1]
    frames = np.linspace(0, count - 1, SHOWN).round().astype(int)
    rows = [(_name(name), [video[0, t] for t in frames]) for name, video in videos.items()]
    save_png(folder / "horizon.png", grid(rows, [str(t + 1) for t in frames], cell=112))
    columns = [(_name(name), video[0]) for name, video in videos.items()]
    pictures = [x[: x.shape[0] // 2 * 2, : x.shape[1] // 2 * 2] for x in small_frames(columns)]
    with atomic.replacing(folder / "horizon.mp4") as partial:
        partial.write_bytes(encode_h264(pictures, FRAMES_PER_SECOND))
    page = folder / "horizon.html"
    with atomic.replacing(page) as partial:
        partial.write_text(_page(facts, ends))
    return page


def lines(facts: Mapping[str, Any], ends: Sequence[int]) -> list[str]:
    """Return the lines for the terminal: one per method."""
    said = [f"PSNR in dB of frames {', '.join(_spans(ends))}:"]
    for name, values in facts["psnr"].items():
        said.append(f"  {_name(name):<26}" + "  ".join(f"{value:6.2f}" for value in values))
    for name, found in facts.get("distances", {}).items():
        scores = ", ".join(
            f"{end}: FVD {one['fvd']['value']:.0f}, KVD {one['kvd']['value']:.2f} "
            f"({one['fvd']['clips']} clips)"
            for end, one in found.items()
        )
        said.append(f"  {_name(name)}: {scores}")
    return [*said, *sentences(facts)]


def sentences(facts: Mapping[str, Any]) -> list[str]:
    """Return sentences about a voxel world: its autoencoder, and blocks placed in it."""
    said = []
    if "autoencoder" in facts:
        back = facts["autoencoder"]
        said.append(
            f"The 3D VAE reconstructs {100 * back['occupied']:.1f} % of the occupied cells with "
            f"their class ({100 * back['filled']:.1f} % as occupied) and {100 * back['empty']:.1f} "
            f"% of the empty ones, of {back['grids']} recorded grids."
        )
    if "edits" in facts:
        edits = facts["edits"]
        said.append(
            f"Placed blocks that persisted: {edits['stayed']} of {edits['trials']} "
            f"({100 * edits['share_of_cells']:.0f} % of their cells; {edits['without_room']} more "
            f"walks had no room); in {edits['frames_in_window']} of {edits['frames']} frames a "
            "part was in the window that may change, where a known cell changes if another class "
            f"is likelier by {edits['hold']:g} nats. The image changed at the block in "
            f"{edits['changed_in_sight']} of {edits['frames_in_sight']} frames in which it was "
            "visible."
        )
    return said


def _spans(ends: Sequence[int]) -> list[str]:
    """Return the names of the segments between ends, such as 1–200 and 201–400."""
    return [f"{low + 1}–{high}" for low, high in zip((0, *ends[:-1]), ends, strict=True)]


def _name(name: str) -> str:
    return NAMES.get(name, name)


def _page(facts: Mapping[str, Any], ends: Sequence[int]) -> str:
    psnr = Table.of(
        ["", *_spans(ends)],
        [
            [_name(name), *(Cell(value) for value in values)]
            for name, values in facts["psnr"].items()
        ],
    )
    sections: list[Section] = [Section("PSNR in dB, by frames", [TableBlock(psnr)])]
    if "bound" in facts["psnr"]:
        note = "The renderer with the true voxels and cameras is an upper bound of the world."
        sections.append(Section("", [Text(note, "quiet")]))
    if facts.get("distances"):
        distances = Table.of(
            ["", "frames before", "FVD", "KVD", "clips"],
            [
                [
                    _name(name),
                    end,
                    Cell(one["fvd"]["value"], 0),
                    Cell(one["kvd"]["value"]),
                    str(one["fvd"]["clips"]),
                ]
                for name, found in facts["distances"].items()
                for end, one in found.items()
            ],
        )
        sections.append(Section("Windows of 16 frames, as sets", [TableBlock(distances)]))
    figures = [
        Figure("horizon.png", alt="Frames of a walk."),
        Figure("horizon.mp4", media="video/mp4"),
    ]
    sections.append(Section("", [*(Text(line) for line in sentences(facts)), *figures]))
    protocol = [(str(name), str(value)) for name, value in facts["protocol"].items()]
    sections.append(Section("How it was measured", [Facts(protocol)]))
    opening = (
        "Each walk starts with a few observed frames and continues with the recorded actions only."
    )
    return render("Long horizons", [Text(opening, "lead")], sections)
