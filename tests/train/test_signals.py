"""Signals: the clock starts with them, whatever the main thread is in, and each ends in words."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pewm_jax.train.signals import Interrupted, Stop

ROOT = Path(__file__).parents[2]
BUSY = """
import hashlib, sys
from pewm_jax.train import signals
signals.LINGER_S = 0.3

def busy():  # a call of compiled code that knows no signals and lets other threads run
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"word", b"salt", 2_000_000_000)

try:
    with signals.Stop({grace}) as stop:
        stop.at_once = {at_once}
        stop.kept = lambda: "the checkpoint of step 30 is intact"
        busy()
except signals.Interrupted as left:  # the signal came before the call
    print(left, file=sys.stderr)
    sys.exit(left.exit_code)
"""


def told(grace, at_once, *numbers, apart=0.3):
    """Send signals to a process that is busy; returns its exit code and what it says."""
    code = BUSY.format(grace=grace, at_once=at_once)
    command = [sys.executable, "-c", code]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.2)
        for number in numbers:
            process.send_signal(number)
            time.sleep(apart)
        _, err = process.communicate(timeout=60)
        return process.returncode, err


def test_where_saving_outlasts_the_grace_the_process_ends_by_itself():
    code, err = told(1, False, signal.SIGTERM, signal.SIGTERM, apart=0.0)  # an echo is no second
    assert code == 143
    asked, left = err.split("\n")[1::2]
    assert asked == (
        "Stopping: saves after this step and exits within 1 s; send the signal again to exit "
        "without saving."
    )
    assert left == (
        "Exited before saving was done, because the 1 s of train.grace_s are over (the checkpoint "
        "of step 30 is intact); run the same command again to resume."
    )


def test_with_nothing_to_save_it_ends_soon():
    code, err = told(3600, True, signal.SIGINT)
    assert code == 130
    assert err.strip() == (
        "Stopped with nothing to save (the checkpoint of step 30 is intact); run the same command "
        "again to resume."
    )


def test_a_second_signal_leaves_at_once():
    code, err = told(3600, False, signal.SIGTERM, signal.SIGINT)
    assert code == 143
    assert err.split("\n")[-2] == (
        "Exited immediately (the checkpoint of step 30 is intact); run the same command again to "
        "resume."
    )


def test_what_may_be_broken_off_is_and_all_else_is_not():
    with Stop() as stop:
        stop.at_once = False
        assert stop.unless_requested(lambda: 3) == 3
        assert not stop.due()
        done = []

        def tell():
            os.kill(os.getpid(), signal.SIGTERM)
            done.append("on")

        tell()
        assert done == ["on"]
        assert stop.due()
        assert stop.unless_requested(lambda: 3) is None
    with Stop() as stop:
        stop.at_once = False
        assert stop.unless_requested(tell) is None
        assert done == ["on"]
        assert stop.requested
        assert "after step 7 of stage 2" in str(stop.interrupted("stage 2", 7))
        assert stop.interrupted("stage 2", 7).exit_code == 143


def test_before_the_first_step_the_first_signal_is_the_end():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(Interrupted, match="nothing to save") as left, Stop():
        os.kill(os.getpid(), signal.SIGINT)
    assert left.value.exit_code == 130
    assert signal.getsignal(signal.SIGINT) == before
    assert not any(thread.name == "signals" for thread in threading.enumerate())


def test_of_several_processes_none_breaks_off_and_all_stop_when_agreed():
    agreed = iter([None, signal.SIGTERM, None])
    with Stop(agreed=lambda _number: next(agreed), alone=False) as stop:
        stop.at_once = False
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.unless_requested(lambda: 3) == 3
        assert not stop.requested
        assert not stop.due()
        assert stop.due()
        assert stop.requested
        assert stop.due()
        assert stop.interrupted("stage 1", 2).exit_code == 143
