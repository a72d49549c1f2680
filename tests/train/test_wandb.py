"""Weights & Biases get the scalars when asked for; a module stands in for the package."""

import sys
import types

import pytest

from pewm_jax.config import UserError
from pewm_jax.train import loop, runs
from tests.train import fakes


class FakeError(Exception):
    pass


class Fake(types.ModuleType):
    """Writes down what it is told, as the package does, by the name of the run."""

    Error = FakeError

    def __init__(self, refusal=""):
        super().__init__("wandb")
        self.begun, self.steps, self.ended, self.refusal = [], [], [], refusal

    def Settings(self, **settings):
        return settings

    def init(self, **given):
        if self.refusal:
            raise FakeError(self.refusal)
        self.begun.append(given)
        name = given["id"]
        return types.SimpleNamespace(
            log=lambda scalars, step: self.steps.append((name, step, scalars)),
            finish=lambda exit_code: self.ended.append((name, exit_code)),
        )


@pytest.fixture
def wandb(monkeypatch):
    fake = Fake()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


@pytest.fixture
def model(monkeypatch):
    fakes.install(monkeypatch)


def test_both_stages_send_their_scalars_under_one_name(model, wandb, tmp_path):
    loop.train(fakes.config(tmp_path / "run", stage1=3, stage2=2, log=("wandb:rooms",)))
    one, two = wandb.begun
    assert (one["project"], one["group"], one["dir"]) == ("rooms", "run", str(tmp_path / "run"))
    assert one["id"].removesuffix("stage1") == two["id"].removesuffix("stage2")
    assert one["config"]["train"]["stage1"]["steps"] == 3
    assert [(name[-6:], step) for name, step, _ in wandb.steps] == [
        *(("stage1", step) for step in (1, 2, 3)),
        *(("stage2", step) for step in (1, 2)),
    ]
    assert {"loss", "learning_rate", "grad_norm"} <= wandb.steps[0][2].keys()
    assert [code for _, code in wandb.ended] == [0, 0]


def test_a_training_that_goes_on_goes_on_in_the_same_run(model, wandb, tmp_path, monkeypatch):
    config = fakes.config(tmp_path, stage1=6, stage2=0, log=("wandb:rooms",))
    with monkeypatch.context() as patch:
        patch.setattr(loop.MetricsLog, "write", stop_at(4, loop.MetricsLog.write))
        with pytest.raises(RuntimeError, match="enough"):
            loop.train(config)
    assert wandb.ended[-1][1] == 1
    loop.train(config)
    before, after = wandb.begun
    assert before["id"] == after["id"]
    assert after["resume"] == "allow"
    assert wandb.steps[-1][1] == 6


def stop_at(last, write):
    def stopping(log, step, metrics):
        write(log, step, metrics)
        if step == last:
            raise RuntimeError("enough")

    return stopping


def test_nothing_is_imported_or_written_where_it_is_not_asked_for(model, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", None)
    loop.train(fakes.config(tmp_path, stage1=1, stage2=0))
    assert not (tmp_path / "wandb.id").exists()


def test_without_the_package_the_training_is_refused_before_it_begins(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"pip install 'pewm-jax\[wandb\]'\.$"):
        loop.train(fakes.config(tmp_path / "run", log=("wandb:rooms",)))
    assert not (tmp_path / "run").exists()


def test_a_login_that_is_missing_is_one_sentence(model, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", Fake("api_key not configured (no-tty).\ncall login"))
    with pytest.raises(UserError, match="WANDB_MODE=offline") as refusal:
        loop.train(fakes.config(tmp_path, stage1=1, stage2=0, log=("wandb:rooms",)))
    assert "\n" not in str(refusal.value)


def test_a_run_may_be_sent_elsewhere_when_it_goes_on(tmp_path):
    plain, asked = fakes.config(tmp_path), fakes.config(tmp_path, log=("wandb:rooms",))
    assert not runs.differences(runs.identity(plain), runs.identity(asked))


def test_no_log_is_written_if_none_is_asked_for(model, tmp_path):
    loop.train(fakes.config(tmp_path, stage1=1, stage2=1, log=("none",)))
    logs = {"metrics.jsonl", "tensorboard", "rerun", "wandb", "wandb.id"}
    assert not logs & {path.name for path in tmp_path.iterdir()}


def test_logs_may_change_when_a_run_is_resumed(model, tmp_path):
    loop.train(fakes.config(tmp_path, stage1=2, stage2=2, log=("none",)))
    assert not runs.differences(
        *(runs.identity(fakes.config(tmp_path, log=log)) for log in (("none",), ("jsonl",)))
    )
