"""The CUDA search without CUDA: Triton interprets it, and compiles it for devices that are not there."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from avatar.geometry.neighbours import k_nearest, nearest, try_fused

ROOT = Path(__file__).parents[2]

INTERPRETED = """
import torch
from avatar.geometry.kernels import nearest_fused
torch.manual_seed(0)
for frames, count, others in ((2, 70, 150), (1, 1, 1), (3, 32, 64), (1, 33, 65)):
    q, p = torch.randn(frames, count, 3), torch.randn(frames, others, 3)
    q, p = q + 100, p + 100  # where the expanded product form is wrong
    ids = nearest_fused(q, p)
    apart = torch.cdist(q.double(), p.double())
    got, best = apart.gather(-1, ids[..., None])[..., 0], apart.amin(-1)
    assert ids.dtype == torch.long and torch.allclose(got, best, rtol=1e-6), (got - best).abs().max()
q[0, 1, 2], p[0, 5, 0], far = torch.nan, torch.nan, torch.full((1, 1, 3), torch.inf)
ids = nearest_fused(q, p)
assert ids.min() >= 0 and ids.max() < p.shape[1] and not (ids == 5).any()
assert torch.equal(ids[0, 2:], nearest_fused(q[:, 2:], p)[0])  # the others do not care
assert nearest_fused(far, p).item() in range(p.shape[1])
print("agrees")
"""

COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from avatar.geometry.kernels import POINTS, QUERIES, search
kinds = dict(queries="*fp32", points="*fp32", found="*i64", n="i32", m="i32", QUERIES="constexpr", POINTS="constexpr")
source = ASTSource(search, kinds, {"QUERIES": QUERIES, "POINTS": POINTS})
for capability in (80, 90):
    binary = triton.compile(source, target=GPUTarget("cuda", capability, 32)).asm
    assert binary["cubin"] and "st.global" in binary["ptx"]
print("compiles")
"""


def in_fresh_python(code: str, folder: Path, **variables: str) -> subprocess.CompletedProcess:
    """Whether a kernel is interpreted is settled when Triton is imported."""
    told = os.environ | {"TRITON_CACHE_DIR": str(folder), "PYTHONPATH": str(ROOT)} | variables
    script = folder / "script.py"  # a file, for Triton reads the sources of what it compiles
    script.write_text(code)
    return subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=told, check=False)


def test_interpreted_search_agrees_with_all_distances(tmp_path):
    done = in_fresh_python(INTERPRETED, tmp_path, TRITON_INTERPRET="1")
    assert done.stdout.strip() == "agrees", done.stderr


def test_search_compiles_for_devices_that_are_not_here(tmp_path):
    done = in_fresh_python(COMPILED, tmp_path)
    assert done.stdout.strip() == "compiles", done.stderr


def test_a_search_that_fails_once_is_tried_again(monkeypatch, caplog):
    """What a busy driver or a full disk refuses is not given up for good, and is warned of once for each kind."""
    failures = [RuntimeError("busy"), RuntimeError("busy"), OSError("full"), None]
    queries, points = torch.randn(1, 5, 3), torch.randn(1, 7, 3)

    def search(queries, points):
        if failure := failures.pop(0):
            raise failure
        return torch.full(queries.shape[:2], 3)

    kernels = ModuleType("avatar.geometry.kernels")
    kernels.nearest_fused = search
    monkeypatch.setitem(sys.modules, kernels.__name__, kernels)
    monkeypatch.setattr("avatar.geometry.neighbours.WARNED", set())
    assert [try_fused(queries, points) for _ in range(3)] == [None] * 3
    assert torch.equal(try_fused(queries, points), torch.full((1, 5), 3))
    warned = [record.getMessage() for record in caplog.records]
    assert len(warned) == 2 and "RuntimeError: busy" in warned[0] and "OSError: full" in warned[1]


def test_without_triton_nothing_is_tried_and_a_warning_says_so(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "triton", None)
    monkeypatch.delitem(sys.modules, "avatar.geometry.kernels", raising=False)
    monkeypatch.setattr("avatar.geometry.neighbours.WARNED", set())
    assert try_fused(torch.zeros(1, 1, 3), torch.zeros(1, 1, 3)) is None
    kernels = ModuleType("avatar.geometry.kernels")
    kernels.nearest_fused = lambda queries, points: pytest.fail("looked for again")
    monkeypatch.setitem(sys.modules, kernels.__name__, kernels)
    assert try_fused(torch.zeros(1, 1, 3), torch.zeros(1, 1, 3)) is None
    assert len(caplog.records) == 1 and "slow way" in caplog.text and "triton" in caplog.text


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_search_on_cuda_agrees_with_the_trees():
    q, p = torch.randn(2, 5000, 3), torch.randn(2, 4000, 3)
    assert try_fused(q.cuda(), p.cuda()) is not None
    ids = nearest(q.cuda(), p.cuda()).cpu()
    apart = [(q - p.gather(1, i[..., None].expand(-1, -1, 3))).norm(dim=-1) for i in (ids, k_nearest(q, p, 1)[..., 0])]
    torch.testing.assert_close(*apart)
