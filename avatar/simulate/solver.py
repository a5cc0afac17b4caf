"""The cloth solver: newton's Style3D projective dynamics against a moving collider, damped to rest."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass

import numpy as np

from avatar.checks import check_finite, check_range, check_shape, require
from avatar.simulate.mesh_queries import run_kernel, vectors, warp_mesh
from avatar.simulate.outfits import FabricConfig

LONGEST_WAY = 0.005  # metres a vertex may be moved on by momentum in one step
REACH = 0.04  # metres within which the collider is looked for; far above what it moves in a step


@dataclass
class SolverConfig:
    """Numbers of the time stepping. Time only serves to find the rest: it has no meaning of its own."""

    step: float = 1 / 60  # s
    iterations: int = 3  # linearisations a step
    linear_iterations: int = 16  # conjugate-gradient steps each
    momentum: float = 0.9  # share of each step that the next one starts with (heavy ball): speeds up the rest
    contact_stiffness: float = 200.0  # N/m a vertex
    creep: float = 1e-3  # m a step below which friction is viscous, so that cloth forgets how it came here

    def __post_init__(self):
        check_range(self, *vars(self), above=0)


class ClothSolver:
    """One garment over a moving triangle mesh: newton's Style3D with a collision handler of its own, which this is.

    newton's handler treats a mesh as one penalty shape; this one adds smooth directions at edges, the fabric's
    thickness, creeping friction, springs to anchors, and a limit on each step that keeps vertices outside.
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        fabric: FabricConfig,
        collider_points: np.ndarray,
        collider_faces: np.ndarray,
        stiffness: np.ndarray,
        config: SolverConfig | None = None,
    ):
        """Builds the solver of a cut garment ``rest (V, 3)``, metres, ``faces (F, 3)``, over a triangle mesh.

        Lengths are those at rest, folds have none; ``stiffness (V,)`` N/m pulls each vertex to its anchor. Raises
        `AvatarError` for other shapes or numbers that are not finite.
        """
        dims = check_shape("rest", rest, "V 3")
        check_shape("stiffness", stiffness, "V", V=dims["V"])
        check_finite("rest", rest)
        newton, warp = require("newton"), require("warp")
        self.fabric, self.count, self.config = fabric, dims["V"], config or SolverConfig()
        self.mesh, self.iterate = warp_mesh(collider_points, collider_faces, moving=True), None
        self.stiffness = warp.array(stiffness, dtype=float, device="cpu")
        self.points, self.normals, self.drifts, self.anchors, self.products = (
            vectors(np.zeros((self.count, 3))) for _ in range(5)
        )
        self.hessians = warp.zeros(self.count, dtype=warp.mat33, device="cpu")
        with warp.ScopedDevice("cpu"), contextlib.redirect_stdout(io.StringIO()):
            model = build_model(newton, rest, faces, fabric)
            style = newton.solvers.SolverStyle3D
            rounds = style.Config(iterations=self.config.iterations, linear_iterations=self.config.linear_iterations)
            self.solver = style(model, config=rounds)
            self.solver.collision = self
            self.now, self.next = model.state(), model.state()
            self.last = warp.clone(self.now.particle_q)

    def reset(self, positions: np.ndarray, collider_points: np.ndarray) -> None:
        """Puts the cloth somewhere, at rest, over a collider that stands still."""
        self.now.particle_q.assign(np.asarray(positions, np.float32))
        self.last.assign(self.now.particle_q)
        self.moved = np.zeros(len(positions))
        self.move(collider_points)
        self.mesh.velocities.zero_()

    def step(self, collider_points: np.ndarray, anchors: np.ndarray, share: float = 1.0) -> None:
        """Moves the collider and its anchors and advances the cloth by a share of one step, at most all of it."""
        self.move(collider_points)
        self.anchors.assign(np.asarray(anchors, np.float32))
        momentum = self.config.momentum * share
        run_kernel("extrapolate", self.count, self.now.particle_q, self.last, momentum, LONGEST_WAY)
        self.solver.step(self.now, self.next, None, None, self.config.step)
        run_kernel("hold_back", self.count, self.next.particle_q, self.last, share)
        self.now, self.next = self.next, self.now
        self.moved = np.linalg.norm(self.now.particle_q.numpy() - self.last.numpy(), axis=1)

    @property
    def positions(self) -> np.ndarray:
        """Cloth vertices ``(V, 3)``, metres (a copy)."""
        return self.now.particle_q.numpy().copy()

    def move(self, points: np.ndarray) -> None:
        """Moves the collider to new ``(V, 3)`` points; the way since the last call is what friction sees."""
        points = np.asarray(points, np.float32)
        self.mesh.velocities.assign(points - self.mesh.points.numpy())
        self.mesh.points.assign(points)
        self.mesh.refit()

    def frame_begin(self, positions, velocities, step) -> None:
        """Finds the contacts of a step (called by Style3D)."""
        found = self.points, self.normals, self.drifts
        run_kernel("find_contacts", self.count, self.mesh.id, positions, REACH, *found)

    def accumulate_contact_force(self, step, iteration, state, _, __, forces, previous, ___=None) -> None:
        """Adds forces and per-particle Hessians at the current iterate (called by Style3D)."""
        self.iterate = state.particle_q
        found = self.points, self.normals, self.drifts, self.anchors, self.stiffness
        numbers = self.fabric.thickness, self.fabric.friction, self.config.contact_stiffness, self.config.creep
        run_kernel("push_apart", self.count, self.iterate, previous, *found, *numbers, forces, self.hessians)

    def contact_hessian_diagonal(self):
        """The per-particle Hessians (called by Style3D)."""
        return self.hessians

    def hessian_multiply(self, values):
        """Hessian times vectors (called by Style3D)."""
        run_kernel("apply_hessian", self.count, self.hessians, values, self.products)
        return self.products

    def linear_iteration_end(self, steps) -> None:
        """Limits a step to where no particle enters the collider (called by Style3D)."""
        thickness = self.fabric.thickness
        run_kernel("keep_outside", self.count, self.iterate, self.points, self.normals, thickness, steps)

    def frame_end(self, positions, velocities, step) -> None:
        """Stops the motion: momentum is kept by `step` alone (called by Style3D)."""
        velocities.zero_()


def build_model(newton, rest: np.ndarray, faces: np.ndarray, fabric: FabricConfig):
    """A newton model of one cloth whose triangles are at rest as they lie, each in a plane of its own."""
    warp = require("warp")
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -9.81, 0.0))
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    corners = np.asarray(rest, float)[faces]
    along = corners[:, 1] - corners[:, 0]
    length = np.linalg.norm(along, axis=1)
    across = corners[:, 2] - corners[:, 0]
    foot = (across * along).sum(1) / length
    height = np.sqrt(np.maximum((across**2).sum(1) - foot**2, 0))
    panels = np.zeros((len(faces), 3, 2))
    panels[:, 1, 0], panels[:, 2, 0], panels[:, 2, 1] = length, foot, height
    builder.default_edge_ke = fabric.bend
    newton.solvers.style3d.add_cloth_mesh(
        builder,
        pos=warp.vec3(0.0),
        rot=warp.quat_identity(),
        vel=warp.vec3(0.0),
        vertices=np.asarray(rest, float).tolist(),
        indices=np.asarray(faces).ravel().tolist(),
        density=fabric.density,
        panel_verts=panels.reshape(-1, 2),
        panel_indices=np.arange(3 * len(faces)),
        tri_aniso_ke=warp.vec3(fabric.stretch, fabric.stretch, fabric.shear),
        edge_aniso_ke=warp.vec3(fabric.bend, fabric.bend, fabric.bend),
    )
    return builder.finalize(device="cpu")
