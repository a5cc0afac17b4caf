"""anny's bodies, without its minute of construction: a stand-in of its interface, and what is refused."""

import math
from types import SimpleNamespace

import pytest
import torch

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import MIXAMO_NAMES, Phenotype, anny_body, anny_template, build_anny
from avatar.checks import AvatarError

FINGER = "LeftHandIndex1"


class StandIn:
    """A z-up figure with one vertex on each bone, arms hanging slanted, and a finger on the left hand."""

    def __init__(self, **_):
        self.bone_labels = [f"mixamorig:{name}" for name in (*MIXAMO_NAMES, FINGER)]
        self.bone_parents = [*([-1] + [0] * 21), MIXAMO_NAMES.index("LeftHand")]
        self.faces = torch.tensor([[0, 1, 2]])
        self.texture_coordinates = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]], dtype=torch.float64)
        self.face_texture_coordinate_indices = torch.tensor([[3, 1, 2]], dtype=torch.int32)
        self.vertex_bone_indices = torch.arange(23)[:, None]
        self.vertex_bone_weights = torch.ones(23, 1, dtype=torch.float64)
        heads = torch.zeros(23, 3, dtype=torch.float64)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            for step, name in enumerate(("shoulder", "elbow", "wrist")):
                heads[SMPL_JOINTS.index(f"{side}_{name}")] = torch.tensor(
                    [sign * (0.2 + 0.2 * step), 0, 1.4 - 0.1 * step]
                )
        self.heads = heads

    def __call__(self, phenotype_kwargs):
        assert set(phenotype_kwargs) == set(vars(Phenotype()))
        return {"rest_vertices": self.heads[None], "rest_bone_heads": self.heads[None]}


@pytest.fixture
def anny(monkeypatch):
    build_anny.cache_clear()
    monkeypatch.setattr("avatar.body.open.require", lambda name: SimpleNamespace(Anny=StandIn))
    yield
    build_anny.cache_clear()


def test_template_is_y_up_with_fingers_in_the_hand(anny):
    template = anny_template(Phenotype())
    shoulder = template.joints[SMPL_JOINTS.index("left_shoulder")]
    torch.testing.assert_close(shoulder, torch.tensor([0.2, 1.4, 0.0]))
    assert template.weights.shape == (23, 22)
    assert template.weights[22, SMPL_JOINTS.index("left_wrist")] == 1
    assert template.weights[:22].argmax(dim=1).tolist() == list(range(22))
    assert template.uv[template.uv_faces[0]].tolist() == [[1, 1], [1, 0], [0, 1]]


def test_zero_pose_has_horizontal_arms(anny):
    joints = anny_body(Phenotype()).template.joints
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for start, end in (("shoulder", "elbow"), ("elbow", "wrist")):
            arm = joints[SMPL_JOINTS.index(f"{side}_{end}")] - joints[SMPL_JOINTS.index(f"{side}_{start}")]
            torch.testing.assert_close(arm, torch.tensor([sign * math.hypot(0.2, 0.1), 0, 0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("topology", ["default", "smplx", "smpl", ""])
def test_topologies_that_download_a_non_commercial_archive_are_refused(topology):
    with pytest.raises(AvatarError, match="non-commercial"):
        anny_template(Phenotype(), topology)


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_phenotype_out_of_range_is_refused(value):
    with pytest.raises(AvatarError, match=r"height: expected a number in \[0, 1\]"):
        Phenotype(height=value)
