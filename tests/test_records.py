"""Records: what moves with a device or dtype and what stays, and that none can be changed in place."""

from dataclasses import FrozenInstanceError, fields, replace

import pytest
import torch

from avatar.records import Batch, LossTerms, SurfaceSamples, Template


def template() -> Template:
    return Template(
        vertices=torch.rand(4, 3),
        faces=torch.tensor([[0, 1, 2]]),
        weights=torch.ones(4, 1),
        joints=torch.zeros(1, 3),
        parents=(-1,),
        joint_names=("root",),
    )


def test_template_casts_numbers_and_leaves_indices():
    wide = template().to(torch.float64)
    assert {wide.vertices.dtype, wide.weights.dtype, wide.joints.dtype} == {torch.float64}
    assert wide.faces.dtype == torch.int64 and wide.joint_names == ("root",)
    atlas = replace(template(), uv=torch.rand(3, 2), uv_faces=torch.tensor([[0, 1, 2]])).to(torch.float64)
    assert (atlas.uv.dtype, atlas.uv_faces.dtype) == (torch.float64, torch.int64)
    away = template().to("meta")
    assert {tensor.device.type for tensor in (away.vertices, away.faces, away.weights, away.joints)} == {"meta"}


def test_samples_cast_weights_and_leave_indices():
    samples = SurfaceSamples(torch.tensor([[0, 1, 2]]), torch.ones(1, 3) / 3, torch.tensor([0]))
    wide = samples.to(torch.float64)
    assert wide.barycentric.dtype == torch.float64 and wide.vertex_ids.dtype == wide.face_ids.dtype == torch.int64
    away = samples.to("meta")
    assert {t.device.type for t in (away.vertex_ids, away.barycentric, away.face_ids)} == {"meta"}


def test_batch_moves_all_its_tensors():
    tensors = {field.name: torch.rand(1, 2) for field in fields(Batch) if field.name != "names"}
    away = Batch(**tensors, names=("a",)).to("meta")
    assert all(getattr(away, name).device.type == "meta" for name in tensors) and away.names == ("a",)


def test_total_is_the_sum_of_weighted_terms_and_carries_gradient():
    first, second = torch.tensor(2.0, requires_grad=True), torch.tensor(3.0)
    terms = LossTerms(raw={"a": first, "b": second}, weighted={"a": 10 * first, "b": 0.5 * second})
    assert terms.total.item() == 21.5
    terms.total.backward()
    assert first.grad.item() == 10


def test_records_are_frozen():
    with pytest.raises(FrozenInstanceError):
        template().vertices = torch.zeros(4, 3)
