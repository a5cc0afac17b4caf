"""Where a scan lies against its body, and what of it is not the person: values that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar.body.open import open_body
from avatar.data.alignment import ScanSamples, find_stray, fit_similarity, is_flat, sample_skin, tight_weights

TEMPLATE = open_body("female").template
VERTICES, FACES = TEMPLATE.vertices.numpy(), TEMPLATE.faces.numpy()
SKIN = sample_skin(VERTICES, FACES, tight_weights(TEMPLATE))


def scan(ease=0.0):
    """Oriented points an even layer above the body, spread by area."""
    corners = VERTICES[FACES].astype(np.float64)
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, rng = np.linalg.norm(crosses, axis=1), np.random.default_rng(0)
    faces = rng.choice(len(FACES), 20_000, p=areas / areas.sum())
    normals = crosses[faces] / areas[faces, None]
    points = np.einsum("mc,mcx->mx", rng.dirichlet(np.ones(3), 20_000), corners[faces])
    return points + ease * normals, normals


POINTS, NORMALS = scan(0.01)


def test_tight_places_are_head_hands_and_feet():
    places = SKIN.places[SKIN.tight]
    names = list(TEMPLATE.joint_names)
    ends = TEMPLATE.joints.numpy()[
        [names.index(n) for n in ("head", "left_wrist", "right_wrist", "left_foot", "right_foot")]
    ]
    gaps = np.linalg.norm(places[:, None] - ends, axis=2)
    assert gaps.min(axis=1).max() < 0.3 and set(gaps.argmin(axis=1)) == set(range(5))
    assert 0.1 < SKIN.tight.mean() < 0.3
    plain = {"joint_names": tuple(f"bone{i}" for i in range(22))}
    assert tight_weights(type(TEMPLATE)(**vars(TEMPLATE) | plain)) is None


@pytest.mark.parametrize(
    ("scale", "degrees", "shift"), [(1, 0, 0), (0.9, 0, 0), (1.1, 0, 0.02), (1, 8, 0), (0.96, -5, 0.04)]
)
def test_scale_turn_and_shift_are_found_whatever_the_ease(scale, degrees, shift):
    turn = Rotation.from_euler("y", degrees, degrees=True)
    middle = SKIN.places[SKIN.tight].mean(axis=0)
    moved = scale * turn.apply(POINTS - middle) + middle + [0, shift, 0]
    fit = fit_similarity(ScanSamples(moved, turn.apply(NORMALS)), SKIN)
    assert fit.scale == pytest.approx(scale, abs=2e-3)
    assert fit.degrees == pytest.approx(abs(degrees), abs=0.2)
    np.testing.assert_allclose(fit.shift, [0, shift, 0], atol=2e-3)
    assert fit.share > 0.95 and fit.after < 0.02 and fit.roughness < 2e-3


def test_stray_points_are_counted():
    rng = np.random.default_rng(1)
    far, middle = rng.normal(scale=0.01, size=(30, 3)) + [3.0, 0, 0], POINTS.mean(axis=0)
    near = rng.normal(scale=0.01, size=(20, 3)) + middle + [0, 0, 0.5]
    assert find_stray(POINTS, NORMALS, SKIN).count == 0
    stray = find_stray(np.concatenate([POINTS, far, near]), np.concatenate([NORMALS, NORMALS[:50]]), SKIN)
    assert stray.count == 50 and not stray.flat
    gap = SKIN.tree.query(far)[0]
    assert stray.farthest == pytest.approx(gap.max(), abs=0.1)
    assert stray.spread == pytest.approx((30 * (gap**2).mean() + 20 * 0.4**2) / 20_050, rel=0.1)


def test_a_floor_is_flat_and_cloth_is_not():
    flat = np.random.default_rng(2).uniform(-1, 1, (2000, 3)) * [1, 0.002, 1]
    up = np.tile([0.0, 1.0, 0.0], (2000, 1))
    assert is_flat(flat, up)
    turn = Rotation.from_euler("xz", [30, 40], degrees=True)
    assert is_flat(turn.apply(flat), turn.apply(up))
    assert not is_flat(flat * [0.2, 1, 1], up) and not is_flat(POINTS, NORMALS)
