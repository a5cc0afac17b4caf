"""Reliability trials in short versions, and planted faults that the trials must detect."""

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from avatar.checks import AvatarError
from avatar.evaluation.scores import read_scores
from avatar.io import bvh
from avatar.training.trainer import Trainer
from reliability import full_disks, killing, nan_injection, payloads
from reliability.corruption import flip_trial
from reliability.decompression_bombs import bomb_trial
from reliability.findings import Finding, all_of, none_of, to_table
from reliability.full_disks import disk_trial, train_to_step
from reliability.fuzzing import case_of, fuzz_trial, read_mutated
from reliability.hostile_names import hostile_names, name_trial, places_written
from reliability.killing import kill_trial
from reliability.meshing import invalid_clouds, mesh_trial
from reliability.nan_injection import nan_trial
from reliability.races import race_trial
from reliability.small_jobs import JOBS, STEPS, folder_of, prepare, train_job, weights_digest
from reliability.streaming import stream_trial
from reliability.trials import TRIALS, ReliabilityConfig, check_reliability, write_table
from reliability.workers import CRASH, Worker, run_worker

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """One folder for all trials, so that the small jobs are prepared once."""
    return tmp_path_factory.mktemp("reliability")


def unmet(findings: list[Finding]) -> list[str]:
    return [f"{finding.what}: {finding.value} ({finding.goal})" for finding in findings if not finding.met]


SHORT = {
    "kill": lambda root: kill_trial(root, 2, 1, seed=1),
    "flips": lambda root: flip_trial(root, 30, 10, seed=1),
    "nan": lambda root: nan_trial(root, 3, seed=1),
    "race": lambda root: race_trial(root, 1),
    "fuzz": lambda root: fuzz_trial(root, 200, seed=1),
    "bombs": bomb_trial,
    "names": lambda root: name_trial(root, 8, seed=1),
    "mesh": lambda root: mesh_trial(20),
}


@pytest.mark.parametrize("trial", SHORT)
def test_a_short_version_of_each_trial_meets_its_goals(root, trial, monkeypatch):
    monkeypatch.setattr(killing, "JOBS", ("pop", "canonicalizer"))
    monkeypatch.setattr(nan_injection, "JOBS", ("scanimate",))
    assert unmet(SHORT[trial](root)) == []


@pytest.mark.parametrize("mounted", [True, False], ids=["tmpfs", "limit on file sizes"])
def test_checkpoints_survive_a_full_disk(root, monkeypatch, mounted):
    if not mounted:
        monkeypatch.setattr("reliability.full_disks.shutil.which", lambda name: None)
    monkeypatch.setattr(full_disks, "JOBS", ("closet",))
    assert unmet(disk_trial(root / f"disk {mounted}", 1, seed=1)) == []


def test_streamed_training_has_bounded_memory(root):
    assert unmet(stream_trial(root, 0.3, 8)) == []


def test_no_payload_runs_although_every_pickle_would_if_it_were_trusted(root, monkeypatch):
    corpus = payloads.corpus
    assert len(corpus("true")) == 40
    offline = {name: load for name, load in corpus("true").items() if not name.startswith("config")}
    monkeypatch.setattr(payloads, "corpus", lambda command: {name: corpus(command)[name] for name in offline})
    assert unmet(payloads.payload_trial(root)) == []
    names = [*payloads.malicious_objects("true"), *payloads.raw_pickles("true")]
    for number, name in enumerate(names):
        if name == "named as chumpy":
            continue  # chumpy is not installed; nobody could load it
        canary = root / f"canary-{number}"
        command = f"touch {canary}"
        content = (payloads.malicious_objects(command) | payloads.raw_pickles(command))[name]
        data = content if isinstance(content, bytes) else pickle.dumps(content, 2)
        run_worker(lambda data=data: list(pickle.loads(data) or []))
        assert canary.exists(), name


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("place", [STEPS // 2, STEPS // 2 + 1], ids=["at an epoch's end", "amid an epoch"])
def test_a_killed_run_resumes_to_the_bits_of_an_uninterrupted_one(root, job, place):
    assert run_worker(prepare, root).code == 0
    for name in ("uninterrupted", f"killed-{place}"):
        code = name != "uninterrupted" and run_worker(train_and_exit, job, root, name, place).code
        assert code in (False, 9)
        assert run_worker(train_job, job, root, name).code == 0
    digests = {weights_digest(folder_of(job, root, name)) for name in ("uninterrupted", f"killed-{place}")}
    assert len(digests) == 1 and "" not in digests


def train_and_exit(job: str, root: Path, name: str, step: int) -> None:
    """Trains and exits before a step, with the last checkpoint some steps before it or right there."""
    real = Trainer.train_step

    def train_step(trainer, inputs):
        if trainer.step == step:
            os._exit(9)
        return real(trainer, inputs)

    Trainer.train_step = train_step
    train_job(job, root, name)


def test_work_without_a_network(root):
    offline = ["unshare", "--net", "--map-root-user"]
    if shutil.which("unshare") is None or subprocess.run([*offline, "true"], capture_output=True).returncode:
        pytest.skip("this system allows no network namespace")
    code = "from pathlib import Path; from reliability.small_jobs import prepare, train_job; "
    code += f"root = Path({str(root / 'offline')!r}); prepare(root); print(train_job('closet', root))"
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"}
    done = subprocess.run([*offline, sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip().splitlines()[-1], "avatar.safetensors").is_file()


def test_a_loader_that_drops_the_random_state_is_detected(root, monkeypatch):
    resume = Trainer.resume

    def incomplete(trainer):
        resume(trainer)
        if trainer.step:
            torch.manual_seed(0)

    monkeypatch.setattr(Trainer, "resume", incomplete)
    monkeypatch.setattr(killing, "JOBS", ("closet",))
    assert any("final weights" in line for line in unmet(kill_trial(root, 2, 2, seed=2)))


def test_a_reader_that_accepts_nan_is_detected(monkeypatch, tmp_path):
    numbers = [number for number in range(2000) if case_of(number) == ("BVH", "numbers")]
    monkeypatch.setattr(bvh, "FARTHEST", float("inf"))
    assert "invalid" in {read_mutated(tmp_path, number, 0).kind for number in numbers}


def test_a_write_outside_is_recorded():
    recorded = [places_written("open", ("/etc/x", "w", 577)), places_written("os.mkdir", ("/etc/y", 511, -1))]
    assert recorded == [["/etc/x"], ["/etc/y"]]
    assert places_written("open", ("/etc/passwd", "r", 0)) == [] and places_written("import", ("os",)) == []
    assert len(set(hostile_names(200, 0))) > 150


def test_workers_report_values_errors_crashes_and_timeouts():
    def crash():
        raise KeyError("x")

    def refuse():
        raise AvatarError("no")

    assert run_worker(lambda: 3).value == 3
    assert (run_worker(refuse).code, run_worker(refuse).error) == (2, "no")
    assert run_worker(crash).code == CRASH and "KeyError" in run_worker(crash).crash
    assert Worker(lambda: __import__("time").sleep(60)).end(0.2).code is None


def test_findings_become_a_table_and_a_missed_goal_an_error(tmp_path):
    met, missed = all_of("kill", "resumed", 3, 3), none_of("fuzz", "crashes", 1, 9)
    assert met.met and not missed.met
    assert "**1 of 9**" in to_table([met, missed]) and "| 3 of 3 | 3 |" in to_table([met, missed])
    config = ReliabilityConfig(only=("flips",), flips=4, truncations=2, root=tmp_path / "work", out=tmp_path / "out")
    table = check_reliability(config).read_text()
    assert "6 of 6" in table
    assert check_reliability(config).read_text() == table  # finished before: nothing is repeated
    assert {row.method for row in read_scores(tmp_path / "out" / "reliability.csv").rows} == {"flips"}
    missed = (tmp_path / "work" / "flips.json").read_text().replace('"value": 6', '"value": 5')
    (tmp_path / "work" / "flips.json").write_text(missed)
    with pytest.raises(AvatarError, match=r"flips: detected.*5 of 6, the goal was 6"):
        write_table(config)
    with pytest.raises(AvatarError, match="only: expected some of kill"):
        ReliabilityConfig(only=("kills",))
    with pytest.raises(AvatarError, match="kills_in_saves"):
        ReliabilityConfig(kills=2)
    assert set(SHORT) < set(TRIALS) and len(invalid_clouds()) >= 9


def test_the_published_table_is_the_command_s_own():
    results = ROOT / "docs" / "results" / "reliability"
    table = results.with_suffix(".md").read_text()
    assert table in (ROOT / "docs" / "reliability.md").read_text()
    rows = read_scores(results.with_suffix(".csv")).rows
    assert [(row.method, row.metric) for row in rows] == [
        (line.split("|")[1].strip(" `"), line.split("|")[2].strip()) for line in table.splitlines()[2:]
    ]
    assert {row.method for row in rows} == set(TRIALS)


def test_a_run_killed_before_its_first_save_starts_again(root):
    assert run_worker(train_to_step, "closet", root, "early", 1).code == 0
    assert run_worker(train_job, "closet", root, "early").code == 0
