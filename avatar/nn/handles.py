"""Cloth handles: places of a garment whose offsets a Gaussian process predicts from the pose.

A few dozen scans cannot teach a network how a skirt follows the legs, but offsets that are smooth over the garment and
in the pose can be interpolated between them: each training frame has the offset of every handle as parameters, and for
other poses their posterior mean is taken, with a kernel that learns which joints move which part of the garment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist
from torch import Tensor, nn

from avatar.geometry.sparse import SparseRows, gather_sum, pick
from avatar.geometry.surface import farthest_points
from avatar.records import Tensors

NEAREST = 4  # handles that move a vertex
FAR = 1000.0  # metres, more than any way along a garment
GROUPS = 12  # parts of a garment with a kernel each
SCALE = 1.0  # metres one unit of a handle's parameters stands for: steps of Adam are millimetres
FOLDS = 20  # runs of consecutive frames that are left out in turn, each with its mirror images
FIT_STEPS, FIT_RATE = 120, 0.05  # of Adam, on the logarithms of a kernel's parameters
FIT_FRAMES = 256  # about as many at most, evenly spread, a kernel's parameters are fitted to
PRICE = 0.01  # of relevance, against the logarithm of the error
JITTER = 1e-6  # of a kernel's noise, at least
TOLERANCE = 1e-8  # square metres: an error that needs no explanation


@dataclass(frozen=True)
class HandleLayout(Tensors):
    """Handles of a garment of V vertices: each vertex moves by ``shares (V, K)`` of the handles ``ids (V, K)``.

    ``groups (H,)`` is the part of the garment that a handle belongs to.
    """

    ids: Tensor
    shares: Tensor
    groups: Tensor

    @classmethod
    def on_mesh(cls, vertices: Tensor, faces: Tensor, weights: Tensor, count: int) -> HandleLayout:
        """Handles at ``count`` farthest points of a mesh ``(V, 3)``, or at all where it has fewer; at least five.

        A vertex follows its nearest handles along edges, with shares that fall to zero at the next one (Sumner et al.
        2007, embedded deformation); parts are clusters of the skinning weights ``(V, J)`` at the handles.
        """
        places = farthest_points(vertices, min(count, len(vertices))).numpy()
        positions, corners = vertices.double().numpy(), faces.numpy()
        ends = np.unique(np.sort(np.concatenate([corners[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])), axis=0)
        lengths = np.linalg.norm(positions[ends[:, 0]] - positions[ends[:, 1]], axis=1)
        graph = coo_matrix((lengths, ends.T), shape=(len(positions),) * 2)
        distances = dijkstra(graph, directed=False, indices=places).T
        if np.isinf(distances).any():  # handles of other parts come last
            distances = np.where(np.isinf(distances), cdist(positions, positions[places]) + FAR, distances)
        ids = np.argsort(distances, axis=1, kind="stable")[:, : NEAREST + 1]
        near = np.take_along_axis(distances, ids, axis=1)
        shares = (1 - near[:, :-1] / near[:, -1:]) ** 2 + 1e-12
        ids = ids[:, :-1]
        seen = weights.numpy()[places].astype(np.float64)
        kinds = min(GROUPS, len(np.unique(seen.round(2), axis=0)))
        found = kmeans2(seen, kinds, minit="++", seed=np.random.default_rng(0))[1] if kinds > 1 else np.zeros(len(seen))
        groups = torch.from_numpy(np.unique(found, return_inverse=True)[1])
        shares = torch.from_numpy(shares / shares.sum(axis=1, keepdims=True)).float()
        return cls(torch.from_numpy(ids), shares, groups)


class ClothHandles(nn.Module):
    """Offsets of a garment's vertices at rest by handles: parameters of the training frames, and what they predict.

    ``values (N, H, 3)`` are the parameters; `fit` makes the regression from them, which later calls take.
    """

    def __init__(self, layout: HandleLayout, poses: Tensor, triples: Tensor | None = None):
        """Builds handles for training frames with pose features ``(N, J, 9)`` (`pose_features`), of which ``triples
        (T, 3)`` follow each other in time."""
        super().__init__()
        handles, groups = len(layout.groups), int(layout.groups.max()) + 1
        self.values = nn.Parameter(torch.zeros(len(poses), handles, 3))
        state = {**vars(layout), "poses": poses, "relevance": torch.zeros(groups, poses.shape[1])}
        state |= {"duals": torch.zeros(len(poses), handles, 3), "mean": torch.zeros(handles, 3)}
        for name, value in state.items():
            self.register_buffer(name, value.clone(), persistent=True)
        nothing = torch.empty(0, 3, dtype=torch.int64)
        self.register_buffer("triples", nothing if triples is None else triples, persistent=False)

    def forward(self, frames: Tensor) -> Tensor:
        """Offsets ``(B, V, 3)``, metres, of training frames ``(B,)``."""
        return self.spread(pick(self.values, frames) * SCALE)

    def unsteadiness(self) -> Tensor:
        """Mean squared second difference in time of the training frames' offsets, square metres; 0 without triples."""
        if not len(self.triples):
            return self.values.sum() * 0
        before, now, after = (pick(self.values, self.triples[:, place]) * SCALE for place in range(3))
        return (before - 2 * now + after).square().sum(dim=-1).mean()

    def spread(self, offsets: Tensor) -> Tensor:
        """Offsets of handles ``(B, H, 3)`` as those of vertices ``(B, V, 3)``."""
        return gather_sum(offsets, SparseRows.of_table(self.ids, len(self.groups), self.shares))

    def predict(self, poses: Tensor) -> Tensor:
        """Offsets ``(B, V, 3)``, metres, for pose features ``(B, J, 9)``: the posterior mean."""
        likeness = matern(pose_distances(poses, self.poses, self.relevance))  # (C, B, N)
        moved = torch.einsum("hbn,nhc->bhc", likeness[self.groups], self.duals)
        return self.spread(self.mean + moved)

    def fit(self, mirrored: bool) -> None:
        """Fits the kernels to the parameters, and the posterior mean with them; in float64 on the CPU.

        ``mirrored`` says that the second half of the frames are the mirror images of the first. Each group's
        relevance of joints and its noise minimise the error of frames left out (Rasmussen & Williams 5.4.2).
        """
        values = self.values.detach().cpu().double() * SCALE
        poses, groups = self.poses.cpu().double(), self.groups.cpu()
        images = 2 if mirrored else 1
        frames, mean = len(poses) // images, values.mean(dim=0)
        some = torch.arange(frames)[:: -(-len(poses) // FIT_FRAMES)]
        some = torch.cat([some + image * frames for image in range(images)])
        parts = [groups == group for group in range(int(groups.max()) + 1)]
        targets = [(values - mean)[:, part].flatten(1) for part in parts]
        products = torch.stack([each[some] @ each[some].T / each.shape[1] for each in targets])
        relevance, noise = fit_kernels(poses[some], products, fold_numbers(frames).repeat(images)[some])
        duals = torch.zeros_like(values)
        for group, part in enumerate(parts):
            kernel = matern(pose_distances(poses, poses, relevance[group : group + 1]))[0]
            kernel.diagonal().add_(noise[group])
            duals[:, part] = torch.linalg.solve(kernel, targets[group]).unflatten(1, (-1, 3))
        for name, value in (("relevance", relevance), ("duals", duals), ("mean", mean)):
            getattr(self, name).copy_(value.float())


def pose_features(joint_transforms: Tensor, gravity: bool) -> Tensor:
    """What a garment's offsets follow, ``(B, J, 4, 4)`` to ``(B, J, 9)``: each joint's rotation in the root's axes.

    In place of the root's own is the direction of gravity there, or nothing.
    """
    rotations = joint_transforms[..., :3, :3]
    root = rotations[:, :1].transpose(-1, -2)
    features = (root @ rotations).flatten(-2).clone()
    features[:, 0] = 0
    if gravity:
        features[:, 0, :3] = root[:, 0, :, 1]
    return features


def pose_distances(one: Tensor, other: Tensor, relevance: Tensor) -> Tensor:
    """Squared distances ``(C, B, N)`` of pose features ``(B, J, 9)`` and ``(N, J, 9)`` by each relevance ``(C, J)``."""
    first, second = ((part * relevance[:, None, :, None]).flatten(2) for part in (one, other))
    lengths = first.square().sum(dim=-1)[:, :, None] + second.square().sum(dim=-1)[:, None]
    return (lengths - 2 * first @ second.transpose(-1, -2)).clamp(min=0)


def matern(squares: Tensor) -> Tensor:
    """The Matérn kernel of order 3/2 of squared distances."""
    root = (3 * squares + 1e-12).sqrt()
    return (1 + root) * torch.exp(-root)


def fold_numbers(frames: int) -> Tensor:
    """Which of at most `FOLDS` runs of consecutive frames each is in ``(N,)``; neighbours in time leave together."""
    count = min(FOLDS, frames)
    return torch.arange(frames) * count // frames


@torch.enable_grad()
def fit_kernels(poses: Tensor, products: Tensor, folds: Tensor) -> tuple[Tensor, Tensor]:
    """Relevance ``(C, J)`` and noise ``(C,)`` of each group's kernel, by the error of the folds ``(N,)`` left out.

    ``poses (N, J, 9)`` are pose features; ``products (C, N, N)`` are y y^T of the groups' targets, means over their
    columns, square metres.
    """
    (count, joints, _), groups, parts = poses.shape, len(products), fold_members(folds)
    logs = torch.cat([torch.full((groups, joints), -2.0), torch.full((groups, 1), -4.0)], dim=1)
    logs = logs.double().requires_grad_()
    squares = (poses[:, None] - poses).square().sum(dim=-1).flatten(0, 1)  # joint by joint
    identity = torch.eye(count, dtype=torch.float64)
    optimiser = torch.optim.Adam([logs], lr=FIT_RATE)
    for _ in range(FIT_STEPS if len(folds.unique()) > 2 else 0):
        relevance, noise = logs[:, :-1].exp(), logs[:, -1].exp() + JITTER
        kernels = matern((relevance.square() @ squares.T).unflatten(1, (count, count)))
        inverse = torch.linalg.inv(kernels + noise[:, None, None] * identity)
        error = 3 * left_out_error(inverse, products, parts) / len(folds)
        loss = ((error + TOLERANCE).log() + PRICE * relevance.sum(dim=1)).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    found = logs.detach().exp()
    return found[:, :-1], found[:, -1] + JITTER


def fold_members(folds: Tensor) -> list[Tensor]:
    """The frames of each fold of ``(N,)``, as tables ``(P, M)`` of folds of one size."""
    tables: dict[int, list[Tensor]] = {}
    for fold in folds.unique():
        members = (folds == fold).nonzero()[:, 0]
        tables.setdefault(len(members), []).append(members)
    return [torch.stack(rows) for rows in tables.values()]


def left_out_error(inverse: Tensor, products: Tensor, parts: list[Tensor]) -> Tensor:
    """Summed square of how regression without a fold of the frames misses that fold, for all folds in turn: ``(C,)``.

    From the inverses A ``(C, N, N)`` of kernel matrices with their noise, and the products y y^T ``(C, N, N)`` of
    targets alone: a fold b is missed by (A_bb)^-1 (A y)_b (Rasmussen & Williams eq. 5.12). ``parts`` as `fold_members`
    has them.
    """
    spread = inverse @ products @ inverse
    errors = []
    for part in parts:
        rows, columns = part[:, :, None], part[:, None, :]
        own = torch.linalg.inv(inverse[:, rows, columns])
        errors.append((own * (own @ spread[:, rows, columns])).sum(dim=(1, 2, 3)))
    return torch.stack(errors).sum(dim=0)
