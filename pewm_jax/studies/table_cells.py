"""Table 1 as words: rows, columns, labels and numbers, for every form that it is written in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pewm_jax.studies.table import LOWER

COLUMNS: Mapping[str, tuple[str, int]] = {
    "psnr/seen": ("PSNR seen, dB", 2),
    "psnr/unseen": ("PSNR unseen, dB", 2),
    "psnr/all": ("PSNR, dB", 2),
    "ssim/all": ("SSIM", 3),
    "lpips/all": ("LPIPS[alex]", 3),
    "fvd_half": ("FVD", 0),
    "kvd_half": ("KVD", 2),
    "dreamsim": ("DreamSim", 3),
    "src": ("SRC[alex]", 1),
    "depth_mae/all": ("depth, m", 3),
}
"""Measure → heading, decimals; FVD and KVD of halves, which have a floor of as many clips."""

TRUTH = "the truth against itself"
PLACES = "two different places"
"""Rows beside the trained ones: what the truth gets, and what says nothing at all (SRC)."""


def rows_of(results: Mapping[str, Any]) -> list[str]:
    """Return the rows: those of the table as listed, then the backbone, then without a network."""
    listed = list(results["about"]["rows"])
    return [*listed, *(name for name in results["rows"] if name not in listed)]


def columns_of(results: Mapping[str, Any]) -> list[str]:
    """Return the measures that any row has, as listed."""
    rows = results["rows"].values()
    return [name for name in COLUMNS if any(name in row["measures"] for row in rows)]


def heading(results: Mapping[str, Any], measure: str) -> str:
    """Return the heading of a measure; of a distance of sets the name with its number of clips."""
    floor = results["floors"].get(measure.removesuffix("_half"), {})
    return floor.get("name") or COLUMNS[measure][0]


def label(results: Mapping[str, Any], name: str) -> str:
    """Return a row's name for people."""
    known = {
        "backbone": "(the backbone that the others start from)",
        "reproject": "reprojection, no network",
        "copy": "copying the last frame",
    }
    described = results["about"]["rows"].get(name)
    return described["label"].replace("_", " ") if described else known.get(name, name)


def blind(results: Mapping[str, Any], name: str, measure: str) -> bool:
    """Return whether a measure is of depth and the row's model imagines none."""
    about = results["about"]["rows"].get(name, {})
    return measure.startswith("depth") and about.get("depth") is False


def cell(results: Mapping[str, Any], name: str, measure: str) -> tuple[str, str]:
    """Return a number and half its interval, as words; "–" where there is none."""
    entry = results["rows"][name]["measures"].get(measure)
    if entry is None or entry["mean"] is None or blind(results, name, measure):
        return "–", ""
    decimals = COLUMNS[measure][1]
    over = entry if "low" in entry else entry["over_seeds"]
    half = ""
    if over["low"] is not None:
        half = f"{(over['high'] - over['low']) / 2:.{decimals}f}"
    return f"{entry['mean']:.{decimals}f}", half


def best_of(results: Mapping[str, Any], names: Sequence[str], measure: str) -> str:
    """Return the row with the best number among the trained ones."""
    known = [
        (results["rows"][name]["measures"][measure]["mean"], name)
        for name in names
        if name in results["about"]["rows"] and cell(results, name, measure)[0] != "–"
    ]
    if not known or measure == "src":  # a model that always shows one picture is consistent too
        return ""
    lower = measure.split("/", 1)[0] in LOWER
    return (min if lower else max)(known)[1]


def floor_of(results: Mapping[str, Any], measure: str) -> float | None:
    """Return what the truth itself gets; None where that is not measured."""
    floors = results["floors"]
    if measure == "src" and "src[alex]" in floors:
        return floors["src[alex]"]["ceiling"]
    found = floors.get(measure.removesuffix("_half"), {}).get("floor")
    return found["mean"] if found else None


def place_floor(results: Mapping[str, Any], measure: str) -> float | None:
    """Return what pictures of two different places get; None but for SRC."""
    floors = results["floors"]
    return floors["src[alex]"]["floor"] if measure == "src" and "src[alex]" in floors else None


def number_words(number: float | None, measure: str) -> str:
    """Return a number as words; "–" where there is none."""
    return "–" if number is None else f"{number:.{COLUMNS[measure][1]}f}"
