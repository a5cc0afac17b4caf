"""SCANimate's avatar: a pose-aware signed distance in canonical space, extracted and posed by learned skinning."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.body.skinning import skin_transforms
from avatar.checks import AvatarError, check_range, check_shape
from avatar.geometry.chunks import in_chunks
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.geometry.transforms import transform_points
from avatar.implicit import networks
from avatar.implicit.extraction import ExtractionConfig, extract_surface
from avatar.implicit.networks import Attention, MlpConfig, SdfConfig
from avatar.records import Mesh, PointCloud, Template

CHUNK = 65_536  # points skinned or coloured at once


class PoseInput(Enum):
    """What the surface knows of the pose."""

    local = "local"  # joints near in the tree, gated by the skinning weights (SCANimate eq. 18)
    global_ = "global"  # all joints everywhere: the baseline
    none = "none"  # nothing: one shape for all poses, the static floor


@dataclass
class ImplicitConfig:
    """The implicit avatar's switches and sizes; the defaults are the paper's method at full size."""

    sdf: SdfConfig = field(default_factory=SdfConfig)
    texture: MlpConfig = field(default_factory=MlpConfig)
    colored: bool = False  # learn colours as well; the scans must have them
    pose: PoseInput = PoseInput.local
    attention: Attention = Attention.neighbours
    rings: int = 4  # edges of the kinematic tree over which a joint is attended to
    normalised: bool = False  # attention sums to 1 over a joint's neighbours (the paper's code), or each counts fully
    gate_spacing: float = 0.0  # metres between nodes at which skinning weights are read for the gates; 0 reads none

    def __post_init__(self):
        check_range(self, "rings", "gate_spacing", low=0)


class ImplicitAvatar(nn.Module):
    """The dressed surface of one outfit as a signed distance, with the skinning field that poses it.

    The field is frozen; gradients reach the signed distance and the texture alone.
    """

    def __init__(self, template: Template, field: nn.Module, box: Tensor, config: ImplicitConfig):
        """Builds an untrained avatar on the body at rest; ``field`` gives ``(B, N, J)`` weights of canonical points.

        The ``box (2, 3)`` has the corners of canonical space that clothes can reach, metres.
        """
        super().__init__()
        self.config, self.parents = config, tuple(template.parents)
        self.field = field.eval().requires_grad_(False)
        self.register_buffer("box", box.detach().clone(), persistent=False)
        self.register_buffer("canonical_from_bind", template.canonical_from_bind, persistent=False)
        self.gate = networks.PoseGate(self.parents, config.rings, config.attention, config.normalised)
        lattice = config.pose is PoseInput.local and config.gate_spacing
        self.near_field = networks.FieldLattice(self.field, self.box, config.gate_spacing) if lattice else None
        self.sdf = networks.PosedSdf(0 if config.pose is PoseInput.none else self.gate.channels, self.box, config.sdf)
        inputs = self.sdf.mlp.layers[0].in_features
        self.texture = networks.TextureField(inputs, self.sdf.mlp.channels, config.texture) if config.colored else None

    def pose_features(self, points: Tensor, joint_transforms: Tensor) -> Tensor:
        """Pose features ``(B, N, P)`` of each point; see `PoseInput`."""
        dims = check_shape("points", points, "B N 3")
        if self.config.pose is PoseInput.none:
            return points.new_zeros(*points.shape[:2], 0)
        if self.config.pose is PoseInput.global_:
            quaternions = networks.joint_quaternions(joint_transforms, self.parents).flatten(1)
            return quaternions[:, None].expand(-1, dims["N"], -1)
        return self.gate((self.near_field or self.field)(points), joint_transforms)

    def forward(self, points: Tensor, joint_transforms: Tensor) -> Tensor:
        """Signed distances ``(B, N)`` of canonical points ``(B, N, 3)``, metres, negative inside.

        ``joint_transforms (B, J, 4, 4)`` are posed_from_canonical; global motion in them changes nothing.
        """
        return self.sdf(points, self.pose_features(points, joint_transforms))

    def colors(self, points: Tensor, joint_transforms: Tensor) -> Tensor:
        """Colours ``(B, N, 3)`` in [0, 1] at canonical points; what geometry gives to them is not trained by them.

        Raises `AvatarError` for an avatar without texture.
        """
        if self.texture is None:
            raise AvatarError("colors: this avatar was trained without texture (method.settings.avatar.colored=true).")
        with torch.no_grad():
            inputs = self.sdf.inputs(points, self.pose_features(points, joint_transforms))
            features = self.sdf.mlp.features(inputs)
        return self.texture(inputs, features)

    @torch.no_grad()
    def canonical_mesh(self, joint_transforms: Tensor, config: ExtractionConfig | None = None) -> Mesh:
        """The surface of a pose ``(J, 4, 4)``, posed_from_canonical, in canonical space; with the colours there are."""
        check_shape("joint_transforms", joint_transforms, "J 4 4", J=len(self.parents))
        pose = joint_transforms[None].to(self.box)
        mesh = extract_surface(lambda points: self(points[None], pose)[0], self.box, config)
        if self.texture is None:
            return mesh
        vertices = torch.from_numpy(mesh.vertices).to(self.box)
        colors = in_chunks(lambda chunk: self.colors(vertices[chunk][None], pose)[0], len(vertices), CHUNK)
        return replace(mesh, colors=torch.cat(colors).cpu().numpy())

    @torch.no_grad()
    def pose_mesh(self, mesh: Mesh, joint_transforms: Tensor) -> Mesh:
        """A mesh in canonical space posed by forward LBS with the field's weights, global motion included.

        ``joint_transforms (J, 4, 4)`` are posed_from_canonical.
        """
        vertices = torch.from_numpy(mesh.vertices).to(self.box)
        pose = joint_transforms[None].to(self.box)

        def pose_chunk(chunk: slice) -> Tensor:
            transforms = skin_transforms(self.field(vertices[chunk][None]), pose, self.canonical_from_bind)
            return transform_points(transforms, vertices[chunk][None])[0]

        return replace(mesh, vertices=torch.cat(in_chunks(pose_chunk, len(vertices), CHUNK)).cpu().numpy())


def sample_mesh(mesh: Mesh, count: int, seed: int = 0) -> PointCloud:
    """Points with smooth normals, spread evenly by area over a mesh; fixed by the seed."""
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    samples = sample_surface(vertices, faces, count, torch.Generator().manual_seed(seed))
    normals = normalize(interpolate(vertex_normals(vertices, faces), samples), dim=-1, eps=1e-20)
    return PointCloud(interpolate(vertices, samples).numpy(), normals.numpy())
