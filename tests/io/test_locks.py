"""One job a folder, however the other one dies; signals that end the work where its state is saved."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from avatar.checks import AvatarError
from avatar.io.locks import LOCK, lock_folder
from avatar.training.signals import Stopped, stop_requests

HOLD = "import sys, time; from pathlib import Path; from avatar.io.locks import lock_folder\n"
HOLD += "with lock_folder(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the folder."""
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_job_is_refused_by_name_and_a_killed_one_holds_nothing(tmp_path, holder):
    with pytest.raises(AvatarError, match=rf"process {holder.pid} on .*name="), lock_folder(tmp_path):
        pass
    holder.kill()
    holder.wait()
    assert (tmp_path / LOCK).stat().st_size  # a stale lock by its looks
    with lock_folder(tmp_path):
        assert str(os.getpid()) in (tmp_path / LOCK).read_text()
    assert not (tmp_path / LOCK).read_text()


def test_the_holder_may_enter_again_but_no_other_thread(tmp_path):
    refused = []

    def other():
        try:
            with lock_folder(tmp_path):
                pass
        except AvatarError as error:
            refused.append(str(error))

    with lock_folder(tmp_path), lock_folder(tmp_path / ".." / tmp_path.name):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(refused) == 1 and str(os.getpid()) in refused[0]
    other()
    assert len(refused) == 1


def race(folder: Path) -> int:
    """Forks two jobs for one folder; how many got it while the other was there."""
    gate, children = os.pipe(), []
    for _ in range(2):
        child = os.fork()
        if child == 0:
            os.read(gate[0], 1)
            try:
                with lock_folder(folder):
                    time.sleep(0.05)
            except AvatarError:
                os._exit(1)
            os._exit(0)
        children.append(child)
    os.write(gate[1], b"go")
    return sum(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0 for child in children)


def test_two_jobs_never_both_get_a_folder(tmp_path):
    assert [race(tmp_path) for _ in range(20)] == [1] * 20


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_is_noted_and_raised_when_all_is_saved(tmp_path, number):
    before = signal.getsignal(number)
    with pytest.raises(Stopped, match=rf"{signal.Signals(number).name}.*same command"), stop_requests() as stop:
        assert stop.number is None
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGTERM)  # asking twice changes nothing
        assert stop.number == number
        stop.leave(tmp_path)
    assert signal.getsignal(number) == before


def test_an_earlier_listener_hears_the_signal_after_the_save(tmp_path, monkeypatch):
    heard = []
    before = signal.signal(signal.SIGUSR2, lambda number, frame: heard.append(number))  # as submitit does
    try:
        with pytest.raises(Stopped), stop_requests() as stop:
            os.kill(os.getpid(), signal.SIGUSR2)
            assert heard == []
            stop.leave(tmp_path)
        assert heard == [signal.SIGUSR2]
    finally:
        signal.signal(signal.SIGUSR2, before)
