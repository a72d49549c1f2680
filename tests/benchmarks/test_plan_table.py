"""The tables of all presets: kept programs, rows, and the page."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from pewm_jax import presets
from pewm_jax.config import DataConfig, UserError
from pewm_jax.plan import inference, suggest
from pewm_jax.plan.measure import MeshSizes
from pewm_jax.train import runs
from tests.plan.test_target_compiler import report

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import plan_table

    asked = []

    def compile_stage(config, name, chip, devices, slices):
        asked.append((name, chip.name, devices if slices == 1 else (devices, slices)))
        if chip.name == "v5p" and name == "stage2":
            raise UserError("The compiler of v5p failed on stage2: no.")
        return report(name=name, chip=chip.name, devices=devices)

    def compile_inference(config, name, chip):
        asked.append((name, chip.name, 1))
        return report(name=name, chip=chip.name, devices=1, fits_gb=inference.fits_gb(20e9))

    monkeypatch.setattr(plan_table.topology, "require_compiler", lambda chip: None)
    monkeypatch.setattr(plan_table.topology, "compiler", lambda chip: {"name": "c", "version": "1"})
    monkeypatch.setattr(plan_table.target_compiler, "compile_stage", compile_stage)
    monkeypatch.setattr(plan_table.target_compiler, "compile_inference", compile_inference)
    yield plan_table, asked
    for name in ("plan_table", "record"):
        sys.modules.pop(name, None)


def test_both_tables_are_printed_and_finished_programs_are_kept(tables, tmp_path, capsys):
    plan_table, asked = tables
    flags = ["--presets", "tiny", "--chips", "h100", "v5p", "--folder", str(tmp_path / "kept")]
    plan_table.main(flags)
    names = inference.names(plan_table.presets.load("tiny"))
    stages = [(name, chip, 8) for chip in ("h100", "v5p") for name in ("stage1", "stage2")]
    assert asked == stages + [(name, chip, 1) for chip in ("h100", "v5p") for name in names]
    printed = capsys.readouterr().out
    assert "| tiny | 1 | 8 × h100 | fsdp 8 | 34.00 GiB of 95.00 GiB | yes |" in printed
    assert "| splash | 8.7 s | flops | 75% |" in printed
    assert "| tiny | 2 | 8 × v5p | The compiler of v5p failed on stage2: no. |" in printed
    assert "| h100 | 34.00 GiB | **no** | yes | yes |" in printed
    asked.clear()
    plan_table.main([*flags, "--only", "training", "--kept"])
    assert asked == []
    plan_table.main(flags)
    assert asked == [("stage2", "v5p", 8)], "a failure is tried again"
    asked.clear()
    plan_table.main([*flags, "--only", "inference", "--names", "start", "--folder", str(tmp_path)])
    assert asked == [("start", "h100", 1), ("start", "v5p", 1)]


def test_the_paper_s_presets_are_compiled_for_many_devices_and_slices_too(
    tables, tmp_path, monkeypatch, capsys
):
    plan_table, asked = tables
    monkeypatch.setattr(plan_table, "LARGE", ("tiny",))
    flags = ["--presets", "tiny", "--only", "training", "--folder", str(tmp_path)]
    plan_table.main([*flags, "--names", "stage1"])
    wide = [("stage1", "v5p", (64, 4)), ("stage1", "v5e", 256)]
    assert asked == [("stage1", "h100", 8), ("stage1", "v5p", 8), *wide]
    assert "| tiny | 1 | 64 × v5p in 4 slices | fsdp 8 |" in capsys.readouterr().out


def test_the_page_gets_all_recorded_programs(tables, tmp_path, monkeypatch, capsys):
    plan_table, asked = tables
    page, results = tmp_path / "scaling.md", tmp_path / "results.json"
    page.write_text((ROOT / "docs" / "scaling.md").read_text())
    flags = ["--page", str(page), "--results", str(results), "--folder", str(tmp_path / "kept")]
    for chip in ("v5p", "h100"):
        plan_table.main(["--presets", "tiny", "--chips", chip, *flags, "--record"])
    asked.clear()
    plan_table.main(["--presets", "tiny", "--chips", "v5p", *flags, "--record", "--kept"])
    text = page.read_text()
    capsys.readouterr()
    plan_table.main(["--recorded", *flags])
    assert asked == [], "compiled again"
    printed = capsys.readouterr().out
    for which in plan_table.CHIPS:
        inside = text.split(f"<!-- plan-{which} -->")[1].split(f"<!-- /plan-{which} -->")[0]
        chips = [line.split(" | ")[2] for line in inside.splitlines() if "| tiny |" in line]
        wanted = (
            ["8 × h100"] * 2 + ["8 × v5p"] if which == "training" else ["h100"] * 5 + ["v5p"] * 5
        )
        assert chips == wanted, "a failure is not recorded"
        assert "Compiled by libtpu 0.0.51." in inside
        assert "†" not in inside
        assert inside.strip() in printed
    with_more = dataclasses.replace(plan_table.presets.load("tiny"), data=DataConfig(path="other"))
    monkeypatch.setattr(plan_table.presets, "load", lambda name: with_more)
    assert "| tiny | 1 † | 8 × h100 |" in plan_table.recorded_text("training", results)


def test_the_page_s_tables_are_the_recorded_ones(tables):
    plan_table, _ = tables
    text = (ROOT / "docs" / "scaling.md").read_text()
    for which in plan_table.CHIPS:
        inside = text.split(f"<!-- plan-{which} -->")[1].split(f"<!-- /plan-{which} -->")[0]
        recorded = plan_table.recorded_text(which, plan_table.RESULTS)
        # Settings may have changed since.
        assert inside.split("Compiled by")[0].replace(" †", "").strip() == (
            recorded.split("Compiled by")[0].replace(" †", "").strip()
        )


@pytest.mark.parametrize(("preset", "stage"), [("pewm_2b", "stage1"), ("egowm_cosmos2b", "adapt")])
def test_state_and_batch_are_estimated_as_the_compiler_counts_them(tables, preset, stage):
    plan_table, _ = tables
    recorded = json.loads(plan_table.RESULTS.read_text())[f"training/{preset}-{stage}-h100-8"]
    config = presets.load(preset)
    (found,) = (one for one in runs.planned(config) if one.name == stage)
    memory = suggest.memory_of(config, found, MeshSizes(**recorded["report"]["mesh"]))
    assert memory.state == pytest.approx(recorded["report"]["argument_bytes"], rel=0.01)


@pytest.mark.parametrize(
    ("goal", "arguments", "command", "compilers"),
    [
        ("plan-table", "--only training", "benchmarks/plan_table.py --only training", True),
        ("plan-table", "--recorded", "benchmarks/plan_table.py --recorded", False),
        ("test-all", "-x", "pytest", True),
    ],
)
def test_make_installs_the_compilers_for_what_needs_them(goal, arguments, command, compilers):
    done = subprocess.run(
        ["make", "--dry-run", "--always-make", goal, f"ARGS={arguments}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert command in done.stdout
    assert ("plan-tpu,plan-cuda" in done.stdout) == compilers
