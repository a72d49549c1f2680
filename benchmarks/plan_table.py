"""The tables of docs/scaling.md by the chips' own compilers: training and inference.

    make plan-table                                  # both tables; hours on two cores
    make plan-table ARGS="--only training --chips h100 --presets pewm_2b"
    make plan-table ARGS=--record                    # adds them to plan_table.json and the page
    make plan-table ARGS=--recorded                  # prints plan_table.json; compiles nothing

No device is needed, only the extras plan-tpu and plan-cuda. Every number is one that `pewm-jax plan
PRESET --chip C --devices N --compiler target [--inference]` prints. Finished programs are kept in
``--folder`` by their settings, the chip and the compiler's version: after an interruption, run the
same command again, or use them alone (``--kept``). After a change of the library's code, choose
another folder. ``plan_table.json`` has the last report of every program; the tables of the page are
written from it.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from record import machine, record, table

from pewm_jax import presets
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config, UserError, serialize
from pewm_jax.io import atomic
from pewm_jax.io.store import TABLE, ResultCache, inputs_hash, map_resumable
from pewm_jax.plan import inference, target_compiler, topology
from pewm_jax.plan.plan import arranged, flop, gib
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train import chips, runs
from pewm_jax.train.chips import Chip
from pewm_jax.train.log import duration

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
RESULTS = Path(__file__).with_suffix(".json")
"""The recorded reports: name of a program → its ``Piece``, its settings' hash, the report."""
ADDED = {
    "denoised_lpips": 0.0,
    "denoised_lpips_net": "vgg",
    "denoised_lpips_weights": "signal",
    "frames": 0,
    "whole": 0.0,
    "asked_alone": False,
    "draft": {"kind": "none"},
    "start_draft": "",
}
"""Settings that older records lack, with the values that change no program."""
PRESETS = ("pewm_2b", "pewm_5b", "pewm_5b_i2v", "egowm_svd", "egowm_cosmos2b", "persist_xl")
TRAINING, INFERENCE = "training", "inference"
CHIPS = {TRAINING: ("h100", "v5p"), INFERENCE: ("h100", "a100", "v5e", "v6e")}
"""Chips of each table; the compilers of GPUs are faster."""
DEVICES = 8
MANY = (("v5p", 64, 4), ("v5e", 256, 1))
"""Chip, number of devices and of slices: larger arrangements of the presets of ``LARGE``."""
LARGE = ("pewm_2b", "pewm_5b")
FSDP = {("pewm_5b", "v5e"): 32}
"""Devices along ``fsdp`` where the preset's are too few for the chip's memory."""
HEADS = {
    TRAINING: (
        *("model", "stage", "devices", "mesh", "memory of a device", "fits", "executed"),
        *("attention", "step at best", "bound by", "MFU", "compiled in (CPU)"),
    ),
    INFERENCE: (
        *("model", "program", "chip", "memory", *(f"{gb} GB" for gb in inference.CARDS_GB)),
        *("executed", "at best", "bound by", "compiled in (CPU)"),
    ),
}


@dataclasses.dataclass(frozen=True)
class Piece:
    """A program of a table.

    Attributes:
        table: which one.
        preset: its name.
        name: the stage, or the program of inference.
        title: its description.
        chip: the kind of device.
        devices: their number.
        slices: the number of slices that they make up.
        fsdp: the number of them along ``fsdp``; 0 for the preset's.
    """

    table: str
    preset: str
    name: str
    title: str
    chip: Chip
    devices: int
    slices: int = 1
    fsdp: int = 0

    @property
    def config(self) -> Config:
        """Return the settings."""
        config = presets.load(self.preset)
        if not self.fsdp:
            return config
        mesh = dataclasses.replace(config.train.mesh, fsdp=self.fsdp)
        return dataclasses.replace(config, train=dataclasses.replace(config.train, mesh=mesh))

    @property
    def key(self) -> str:
        """Return the name of the result, with all that it depends on but the library's code."""
        compiler = topology.compiler(self.chip)
        code = inputs_hash([self.settings, self.name, self.chip.name, self.many, compiler])[:16]
        return f"{self.id}-{code}"

    @property
    def id(self) -> str:
        """Return the name of the program."""
        return f"{self.table}/{self.preset}-{self.name}-{self.chip.name}-{self.many}"

    @property
    def many(self) -> str:
        """Return the number of devices, and of slices if there are several."""
        return f"{self.devices}x{self.slices}" if self.slices > 1 else str(self.devices)

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings that programs depend on."""
        settings = serialize.to_dict(self.config)
        del settings["evaluate"]
        return _without(settings, ADDED)

    @property
    def order(self) -> tuple[Any, ...]:
        """Return a key that sorts programs: by table, number of devices, preset and chip."""
        known, names = [*PRESETS, self.preset], [*CHIPS[self.table], self.chip.name]
        wide = self.devices > DEVICES
        return self.table, wide, known.index(self.preset), names.index(self.chip.name)

    def compile(self) -> StageReport:
        """Ask the chip's compiler."""
        if self.table == TRAINING:
            return target_compiler.compile_stage(
                self.config, self.name, self.chip, self.devices, self.slices
            )
        return target_compiler.compile_inference(self.config, self.name, self.chip)


def _without(settings: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Return settings, and those of their sections, without those that have one of the values."""
    return {
        name: _without(value, values) if isinstance(value, dict) else value
        for name, value in settings.items()
        if name not in values or value != values[name]
    }


def pieces(which: str, options: argparse.Namespace) -> Iterator[Piece]:
    """Yield the programs of a table, those for many devices last."""
    names = options.chips or CHIPS[which]
    for chip in map(chips.named, names):
        for preset in options.presets:
            config = presets.load(preset)
            if which == INFERENCE:
                for name in inference.names(config):
                    yield Piece(which, preset, name, inference.title(config, name), chip, 1)
                continue
            for stage in runs.planned(config):
                count = options.devices or DEVICES
                yield Piece(which, preset, stage.name, stage.title, chip, count, options.slices)
    if which == TRAINING and not options.devices:
        wanted = [one for one in MANY if not options.chips or one[0] in options.chips]
        for (name, devices, slices), preset in itertools.product(wanted, LARGE):
            chip, fsdp = chips.named(name), FSDP.get((preset, name), 0)
            for stage in runs.planned(presets.load(preset)) if preset in options.presets else ():
                yield Piece(which, preset, stage.name, stage.title, chip, devices, slices, fsdp)


def compiled(missing: list[Piece]) -> Iterator[tuple[Piece, dict[str, Any]]]:
    """Yield each program with its numbers; a compiler's failure is kept as its sentence."""
    for piece in missing:
        print(f"{piece.preset}, {piece.title}, {piece.chip.name}: compiling …", flush=True)
        try:
            found = dataclasses.asdict(piece.compile())
        except UserError as error:
            found = {"error": str(error)}
            print(f"  {error}", flush=True)
        yield piece, found


def recorded(results: Path) -> dict[Piece, dict[str, Any]]:
    """Return the recorded programs, sorted, each with its report, machine and settings' hash."""
    told = json.loads(results.read_text()) if results.exists() else {}
    found = {
        Piece(**{**entry["piece"], "chip": chips.named(entry["piece"]["chip"])}): entry
        for entry in told.values()
    }
    return dict(sorted(found.items(), key=lambda item: item[0].order))


def keep(found: dict[Piece, dict[str, Any]], results: Path) -> None:
    """Add reports to the recorded ones, or replace them; failures are left out."""
    entries = recorded(results) | {
        piece: {
            "piece": dataclasses.asdict(piece) | {"chip": piece.chip.name},
            "settings": inputs_hash(piece.settings)[:16],
            "machine": machine("jax"),
            "report": told,
        }
        for piece, told in found.items()
        if "error" not in told
    }
    entries = dict(sorted(entries.items(), key=lambda item: item[0].order))
    told = {piece.id: entry for piece, entry in entries.items()}
    atomic.write_text(results, json.dumps(told, indent=1) + "\n")


def of_today(piece: Piece, entry: dict[str, Any]) -> bool:
    """Tell whether a recorded program has the preset's present settings."""
    return entry["settings"] == inputs_hash(piece.settings)[:16]


def text_of(which: str, found: dict[Piece, dict[str, Any]], machines: Sequence[str]) -> str:
    """Return a table, with the compilers below it."""
    if not found:
        return "None so far."
    compilers = {
        f"{told['compiler']['name']} {told['compiler']['version']}"
        for told in found.values()
        if "error" not in told
    }
    rows = [row(piece, told) for piece, told in found.items()]
    width = len(HEADS[which])
    rows = [[*cells, *[""] * (width - len(cells))] for cells in rows]
    return (
        f"{table(HEADS[which], rows)}\n\nCompiled by {'; '.join(sorted(compilers))}. "
        f"{'; '.join(machines)}."
    )


def recorded_text(which: str, results: Path) -> str:
    """Return the table of the recorded programs."""
    entries = {one: entry for one, entry in recorded(results).items() if one.table == which}
    found = {
        one if of_today(one, entry) else dataclasses.replace(one, title=f"{one.title} †"): entry
        for one, entry in entries.items()
    }
    machines = sorted({entry["machine"] for entry in found.values()})
    text = text_of(which, {one: entry["report"] for one, entry in found.items()}, machines)
    return f"{text} †: with earlier settings of the preset." if " † |" in text else text


def row(piece: Piece, found: dict[str, Any]) -> list[str]:
    """Return a line of a table."""
    head = [piece.preset, piece.title.removeprefix("stage ")]
    apart = f" in {piece.slices} slices" if piece.slices > 1 else ""
    where = f"{piece.devices} × {piece.chip.name}{apart}"
    if "error" in found:
        return [*head, where, found["error"]]
    report = StageReport(**found)
    peak = "more" if report.peak_bytes is None else gib(report.peak_bytes)
    bound = "" if report.roofline_s is None else duration(report.roofline_s)
    times = [bound, report.bound]
    if piece.table == INFERENCE:
        cards = ["yes" if ok else "**no**" for ok in report.fits_gb.values()]
        executed = flop(report.flops_executed)
        return [*head, piece.chip.name, peak, *cards, executed, *times, _seconds(report)]
    kernels = sorted(report.kernels.get("attention", {}))
    fits = "yes" if report.fits else "**no**"
    return [
        *head,
        where,
        arranged({name: n for name, n in report.mesh.items() if n > 1}),
        f"{peak} of {gib(report.capacity_bytes)}",
        fits,
        flop(report.flops_executed),
        _family(kernels),
        *times,
        "" if report.mfu is None else f"{report.mfu:.0%}",
        _seconds(report),
    ]


def _seconds(report: StageReport) -> str:
    """Return the time of compilation, and the processor's."""
    return f"{duration(report.compile_s)} ({duration(report.compile_cpu_s)})"


def _family(kernels: Sequence[str]) -> str:
    """Return the kind of the attention kernels."""
    kinds = {"cudnn": "cuDNN", "splash": "splash"}
    found = {kind for name in kernels for word, kind in kinds.items() if word in name}
    return ", ".join(sorted(found)) or "XLA"


def arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=tuple(CHIPS), help="one of the tables")
    parser.add_argument("--presets", nargs="+", choices=presets.names(), default=PRESETS)
    parser.add_argument(
        "--chips", nargs="+", choices=[chip.name for chip in chips.CHIPS], default=()
    )
    parser.add_argument(
        "--names", nargs="+", default=(), help="stages or programs, such as clip-50"
    )
    parser.add_argument(
        "--devices", type=int, default=0, help=f"of a training; {DEVICES} and more if not given"
    )
    parser.add_argument("--slices", type=int, default=1, help="with --devices: slices of them")
    parser.add_argument("--folder", type=Path, default=Path("runs/plan-table"))
    parser.add_argument("--kept", action="store_true", help="use what the folder has")
    parser.add_argument("--record", action="store_true", help="rewrite results and page")
    parser.add_argument("--recorded", action="store_true", help="print results, compile nothing")
    parser.add_argument("--results", type=Path, default=RESULTS, help="the recorded reports")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to rewrite")
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> None:
    """Compile what is missing, print the tables, and record them if asked to."""
    options = arguments(argv)
    cache = ResultCache(options.folder, TABLE)
    for which in (options.only,) if options.only else CHIPS:
        if options.recorded:
            print(f"\n{recorded_text(which, options.results)}\n")
            continue
        asked = [
            one for one in pieces(which, options) if one.name in (options.names or (one.name,))
        ]
        for chip in {piece.chip for piece in asked}:
            topology.require_compiler(chip)
        if options.kept:
            found = {one: kept for one in asked if (kept := cache.get(one.key)) is not None}
        else:
            found = map_resumable(
                asked,
                lambda piece: piece.key,
                compiled,
                cache=cache,
                what=f"programs of {which}",
                log=print,
                is_usable=lambda _, kept: "error" not in kept,
            )
        print(f"\n{text_of(which, found, [machine('jax')])}\n")
        if options.record:
            keep(found, options.results)
            record(f"plan-{which}", recorded_text(which, options.results), options.page)


if __name__ == "__main__":
    sys.exit(cli.run(main))
