"""Chunks that fit: memory that runs out halves them, results stay the same to the bit, other errors pass."""

import numpy as np
import pytest
import torch
from tiny import SETTINGS

from avatar.checks import AvatarError
from avatar.data.outfits import Outfit
from avatar.geometry.chunks import UNIT, in_chunks
from avatar.geometry.surface import sample_surface
from avatar.implicit.extraction import ExtractionConfig, extract_surface
from avatar.methods.points import body_batch, predict
from avatar.methods.registry import find_method
from avatar.settings import settings_from_dict

OUT_OF_MEMORY = [
    torch.OutOfMemoryError("CUDA out of memory."),
    MemoryError(),
    RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 400 bytes."),
]


def narrow(work, most: int, error: BaseException, sizes: list[int] | None = None):
    """The same work on a machine that holds so many rows at once."""

    def limited(chunk: slice):
        if chunk.stop - chunk.start > most:
            raise error
        if sizes is not None:
            sizes.append(chunk.stop - chunk.start)
        return work(chunk)

    return limited


@pytest.mark.parametrize("error", OUT_OF_MEMORY, ids=lambda error: type(error).__name__)
def test_chunks_are_halved_until_they_fit_and_every_row_comes_once(error):
    sizes: list[int] = []
    parts = in_chunks(narrow(lambda chunk: torch.arange(10_000)[chunk], 2000, error, sizes), 10_000, 5000)
    assert torch.equal(torch.cat(parts), torch.arange(10_000))
    assert set(sizes[:-1]) == {1024} and sizes[-1] == 10_000 % UNIT and len(in_chunks(lambda chunk: chunk, 0, 5)) == 1


def test_what_never_fits_is_one_error_and_other_errors_pass():
    with pytest.raises(AvatarError, match=f"not even {UNIT} rows"):
        in_chunks(narrow(lambda chunk: chunk, 10, MemoryError()), 1000, 1000)
    with pytest.raises(RuntimeError, match="shapes"):
        in_chunks(narrow(lambda chunk: chunk, 10, RuntimeError("shapes differ")), 1000, 1000)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_prediction_in_little_memory_is_the_same_to_the_bit(tiny_outfit: Outfit, monkeypatch, threads):
    torch.manual_seed(0)
    template = tiny_outfit.template
    model = (
        find_method("closet").network(template, 1, settings_from_dict(find_method("closet").Settings, SETTINGS)).eval()
    )
    batch = body_batch([tiny_outfit.load("test", tiny_outfit.frames("test")[0]).body], 0, ("a",))
    samples = sample_surface(template.vertices, template.faces, 9001, torch.Generator().manual_seed(1))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        whole = predict(model, batch, samples)
        forward = type(model).forward

        def limited(self, batch, samples, **switches):
            if len(samples.face_ids) > 2000:
                raise torch.OutOfMemoryError("CUDA out of memory.")
            return forward(self, batch, samples, **switches)

        monkeypatch.setattr(type(model), "forward", limited)
        parts = predict(model, batch, samples)
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(parts.points, whole.points)
    np.testing.assert_array_equal(parts.normals, whole.normals)


def test_a_surface_in_little_memory_is_the_same_to_the_bit():
    torch.manual_seed(0)
    layers = torch.nn.Sequential(torch.nn.Linear(3, 32), torch.nn.Softplus(), torch.nn.Linear(32, 1))

    @torch.no_grad()
    def field(points):
        return points.norm(dim=1) - 0.7 + 0.1 * layers(points)[:, 0]

    def limited(points):
        if len(points) > 3000:
            raise MemoryError
        return field(points)

    box, config = torch.tensor([[-1.0] * 3, [1.0] * 3]), ExtractionConfig(48, lipschitz=3.0)
    whole, parts = extract_surface(field, box, config), extract_surface(limited, box, config)
    np.testing.assert_array_equal(parts.vertices, whole.vertices)
    np.testing.assert_array_equal(parts.faces, whole.faces)
