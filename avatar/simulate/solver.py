"""The cloth solver: newton's Style3D projective dynamics against a moving collider, damped to rest."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass

import numpy as np

from avatar.checks import AvatarError, check_finite, check_shape, require
from avatar.simulate.outfits import FabricConfig

LONGEST_CARRY = 0.005  # metres a vertex may be carried on by momentum in one step
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
        for name, value in vars(self).items():
            if not value > 0:
                raise AvatarError(f"{name}: expected a positive number, got {value}.")


def cpu_array(values: np.ndarray, dtype):
    """A warp array on the CPU with a copy of the values."""
    warp = require("warp")
    kind = np.int32 if dtype is int else np.float32
    return warp.array(np.ascontiguousarray(values, kind), dtype=dtype, device="cpu")


class Collider:
    """A moving triangle mesh that cloth rests on: the body, with inner garments over what they cover."""

    def __init__(self, points: np.ndarray, faces: np.ndarray):
        self.warp = require("warp")
        self.mesh = self.warp.Mesh(
            points=cpu_array(points, self.warp.vec3),
            indices=cpu_array(np.asarray(faces).ravel(), int),
            velocities=self.warp.zeros(len(points), dtype=self.warp.vec3, device="cpu"),
        )

    def move(self, points: np.ndarray) -> None:
        """Moves to new ``(V, 3)`` points; the way since the last call is what friction sees."""
        current = self.mesh.points.numpy()
        self.mesh.velocities.assign(np.asarray(points, np.float32) - current)
        self.mesh.points.assign(np.asarray(points, np.float32))
        self.mesh.refit()

    def reset(self, points: np.ndarray) -> None:
        """Jumps to points, standing still there."""
        self.move(points)
        self.mesh.velocities.zero_()


class Contacts:
    """Contact with the collider and anchor springs, in the place of Style3D's own collision handler.

    newton's handler treats a mesh as one penalty shape; this one adds smooth directions at edges, per-vertex
    thickness, creeping friction, anchors, and a limit on each step that keeps vertices outside.
    """

    def __init__(
        self,
        collider: Collider,
        thickness: np.ndarray,
        friction: np.ndarray,
        anchor_stiffness: np.ndarray,
        config: SolverConfig,
    ):
        from avatar.simulate import kernels

        self.kernels, self.warp, self.config, self.collider = kernels, require("warp"), config, collider
        self.count = len(thickness)
        vec3, mat33 = self.warp.vec3, self.warp.mat33
        self.thickness, self.friction = cpu_array(thickness, float), cpu_array(friction, float)
        self.anchor_stiffness = cpu_array(anchor_stiffness, float)
        self.points, self.normals, self.drifts, self.anchors, self.products = (
            self.warp.zeros(self.count, dtype=vec3, device="cpu") for _ in range(5)
        )
        self.hessians = self.warp.zeros(self.count, dtype=mat33, device="cpu")
        self.positions = None

    def launch(self, kernel, *arguments) -> None:
        """Runs a kernel over all particles."""
        self.warp.launch(kernel, self.count, list(arguments), device="cpu")

    def frame_begin(self, positions, velocities, step) -> None:
        """Finds the contacts of a step (called by Style3D)."""
        mesh = self.collider.mesh.id
        self.launch(self.kernels.find_contacts, mesh, positions, REACH, self.points, self.normals, self.drifts)

    def accumulate_contact_force(self, step, iteration, state, _, __, forces, previous, ___=None) -> None:
        """Adds forces and per-particle Hessians at the current iterate (called by Style3D)."""
        self.positions = state.particle_q
        self.launch(
            self.kernels.push_apart,
            self.positions,
            previous,
            self.points,
            self.normals,
            self.drifts,
            self.anchors,
            self.anchor_stiffness,
            self.thickness,
            self.friction,
            self.config.contact_stiffness,
            self.config.creep,
            forces,
            self.hessians,
        )

    def contact_hessian_diagonal(self):
        """The per-particle Hessians (called by Style3D)."""
        return self.hessians

    def hessian_multiply(self, vectors):
        """Hessian times vectors (called by Style3D)."""
        self.launch(self.kernels.apply_hessian, self.hessians, vectors, self.products)
        return self.products

    def linear_iteration_end(self, steps) -> None:
        """Limits a step to where no particle enters the collider (called by Style3D)."""
        self.launch(self.kernels.keep_outside, self.positions, self.points, self.normals, self.thickness, steps)

    def frame_end(self, positions, velocities, step) -> None:
        """Stops the motion: momentum is carried by `ClothSolver.step` alone (called by Style3D)."""
        velocities.zero_()


class ClothSolver:
    """One garment over one collider; a step moves the collider and lets the cloth follow."""

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        fabric: FabricConfig,
        collider: Collider,
        anchor_stiffness: np.ndarray,
        config: SolverConfig | None = None,
    ):
        """Builds the solver.

        Args:
            rest: ``(V, 3)`` metres, the cut garment: lengths are those at rest, folds have none.
            faces: ``(F, 3)``.
            fabric: what it is made of.
            collider: what it lies on.
            anchor_stiffness: ``(V,)`` N/m, pull of each vertex to its anchor.
            config: time stepping.
        """
        dims = check_shape("rest", rest, "V 3")
        check_shape("anchor_stiffness", anchor_stiffness, "V", V=dims["V"])
        check_finite("rest", rest)
        newton, warp = require("newton"), require("warp")
        warp.config.quiet = True
        self.config = config or SolverConfig()
        with warp.ScopedDevice("cpu"), contextlib.redirect_stdout(io.StringIO()):
            self.model = build_model(newton, rest, faces, fabric)
            self.solver = newton.solvers.SolverStyle3D(
                self.model,
                config=newton.solvers.SolverStyle3D.Config(
                    iterations=self.config.iterations, linear_iterations=self.config.linear_iterations
                ),
            )
            full = np.full(len(rest), 1.0)
            self.contacts = Contacts(
                collider, full * fabric.thickness, full * fabric.friction, anchor_stiffness, self.config
            )
            self.solver.collision = self.contacts
            self.now, self.next = self.model.state(), self.model.state()
            self.last = warp.clone(self.now.particle_q)
        self.collider = collider

    def reset(self, positions: np.ndarray, collider_points: np.ndarray) -> None:
        """Puts the cloth somewhere, at rest, over a standing collider."""
        self.now.particle_q.assign(np.asarray(positions, np.float32))
        self.last.assign(self.now.particle_q)
        self.moved = np.zeros(len(positions))
        self.collider.reset(collider_points)

    def step(self, collider_points: np.ndarray, anchors: np.ndarray, share: float = 1.0) -> None:
        """Moves the collider and its anchors and advances the cloth by a share of one step, at most all of it."""
        kernels, launch = self.contacts.kernels, self.contacts.launch
        self.collider.move(collider_points)
        self.contacts.anchors.assign(np.asarray(anchors, np.float32))
        momentum = self.config.momentum * share
        launch(kernels.extrapolate, self.now.particle_q, self.last, momentum, LONGEST_CARRY)
        self.solver.step(self.now, self.next, None, None, self.config.step)
        launch(kernels.hold_back, self.next.particle_q, self.last, share)
        self.now, self.next = self.next, self.now
        self.moved = np.linalg.norm(self.now.particle_q.numpy() - self.last.numpy(), axis=1)

    @property
    def positions(self) -> np.ndarray:
        """Cloth vertices ``(V, 3)``, metres (a copy)."""
        return self.now.particle_q.numpy().copy()


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
