"""Layered avatar: CloSET's network on a clothed template, with the body's own skin and a garment mesh of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.body.skinning import skin_transforms
from avatar.checks import AvatarError, DataError, check_range
from avatar.data.batches import ACROSS, mirror_map
from avatar.data.outfits import Outfit
from avatar.data.splits import sequence_of, split_outfit
from avatar.geometry.cloth import ClothMesh, bending, body_contact, edge_strain, self_contact
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.geometry.transforms import invert_rigid, transform_points
from avatar.implicit.extraction import ExtractionConfig
from avatar.invocation import command_line, option
from avatar.io.clothed_templates import read_clothed_template
from avatar.methods.base import CANONICALIZER, CLOTHED_TEMPLATE, TrainedAvatar
from avatar.methods.canonicalizer import canonicalizer_folder
from avatar.methods.closet import ClosetAvatar, ClosetConfig, Skinning
from avatar.methods.points import PointMethod, PointTask, body_batch, join_clouds, template_samples
from avatar.methods.settings import FitConfig, RunConfig, Space
from avatar.nn.decoders import Decoded, PoseFrame
from avatar.nn.handles import ClothHandles, HandleLayout, pose_features
from avatar.records import (
    Batch,
    BodyFit,
    ClothedTemplate,
    LossTerms,
    Mesh,
    PointCloud,
    Prediction,
    Surface,
    SurfaceSamples,
    Template,
)

STATE = ("vertices", "faces", "weights", "body_vertex", "covered")  # of the clothed template, saved with the weights
SKIN_SPACING = 0.03  # metres between the skin vertices that are encoded
REST_APART = 0.04  # metres at rest from which on two places of a garment may not touch
MIN_HANDLES = 20  # fewer cannot follow a garment
CLOSE = 0.3  # of rotation matrices' entries, root mean square: more between two frames is no motion
TERMS = ("laplacian", "strain", "bending", "body_contact", "self_contact", "temporal")


class Head(Enum):
    """What the network decodes on the garment."""

    mesh = "mesh"  # its vertices: points lie on the mesh, and normals are the mesh's
    points = "points"  # points of their own and their normals, as CloSET does


@dataclass
class ClothConfig:
    """Weights of what the decoded garment mesh is held to; metres and radians. Zero switches a term off."""

    laplacian: float = 4e5  # mean square of how offsets differ from the mean of their neighbours'
    strain: float = 1.0  # mean squared strain of edges, against the garment template's
    bending: float = 50.0  # mean squared angle between faces: cloth is flat at rest
    bent_rest: bool = False  # bending counts from the garment template's angles instead
    body_contact: float = 1e4  # mean square of what vertices lack of the gap to the body
    self_contact: float = 0.0  # the same between parts of the garment that are apart at rest
    temporal: float = 0.0  # mean squared second difference of the handles between frames that follow each other
    gap: float = 0.003  # metres, from body to garment and from garment to garment

    def __post_init__(self):
        check_range(self, *TERMS, "gap", low=0)


@dataclass
class LayeredConfig(ClosetConfig):
    """CloSET's sizes and switches, and those of the garment mesh."""

    code_skip: bool = True  # the decoders see the garment code itself beside its features
    free_offsets: bool = True  # an offset of each vertex, learned beside the code, is added to the template's
    pose_frame: PoseFrame = PoseFrame.heading  # axes of what network and handles see: a bent person's skirt hangs down
    handles: int = 600  # places of the garment that a Gaussian process moves with the pose; 0 for none
    head: Head = Head.mesh
    cloth: ClothConfig = field(default_factory=ClothConfig)

    def __post_init__(self):
        super().__post_init__()
        if self.handles and self.handles < MIN_HANDLES:
            raise AvatarError(f"handles: expected 0 for none, or at least {MIN_HANDLES}, got {self.handles}.")
        if self.cloth.temporal and not self.handles:
            raise AvatarError("cloth.temporal: it is about the handles, got handles=0. Hint: set it to 0.")


class LayeredAvatar(ClosetAvatar):
    """CloSET's network on the clothed template of one outfit.

    The template is skinned by its own weights, skin vertices are the body's own, and the network moves the garment
    alone: its vertices (``head=mesh``) or points on it (``head=points``). It encodes the garment's vertices and, behind
    them, skin vertices `SKIN_SPACING` apart, of which a body has many more in face and hands.
    """

    def __init__(
        self, template: Template, clothed: ClothedTemplate, config: LayeredConfig, handles: ClothHandles | None = None
    ):
        """Builds the network on the body at rest and a clothed template, whose skin vertices come first."""
        skin = int((clothed.body_vertex >= 0).sum())
        cells = np.floor(clothed.vertices[:skin] / SKIN_SPACING)
        seen = np.append(np.arange(skin, len(clothed.vertices)), np.unique(cells, axis=0, return_index=True)[1])
        garment_faces = clothed.faces[clothed.garment_faces] - skin
        arrays = {"vertices": clothed.vertices[seen], "weights": clothed.weights[seen], "faces": garment_faces}
        encoded = {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}
        super().__init__(replace(template, **encoded, uv=None, uv_faces=None), 1, config)
        for name in STATE:
            value = torch.from_numpy(np.ascontiguousarray(getattr(clothed, name)))
            self.register_buffer(f"clothed_{name}", value, persistent=True)
        bind = template.canonical_from_bind
        self.register_buffer("bind", torch.eye(4).expand(len(template.parents), 4, 4) if bind is None else bind)
        constants = {"seen": torch.from_numpy(seen), "body_faces": template.faces, "garment_faces": encoded["faces"]}
        constants["shown_faces"] = torch.from_numpy(np.flatnonzero(clothed.visible_faces))
        for name, value in constants.items():
            self.register_buffer(name, value.clone(), persistent=False)
        self.handles = handles
        self.skin, self.garment_count = skin, len(clothed.vertices) - skin
        if config.head is Head.mesh:  # normals are those of the mesh
            for decoder in (getattr(self, "garment_decoder", None), self.pose_decoder):
                if decoder is not None:
                    decoder.normal_branch = None

    @property
    def garment_vertices(self) -> SurfaceSamples:
        """The garment's vertices as points of what is encoded."""
        ids = torch.arange(self.garment_count).to(self.vertices.device)
        corners = self.vertices.new_zeros(len(ids), 3)
        corners[:, 0] = 1
        return SurfaceSamples(ids[:, None].expand(-1, 3), corners, torch.full_like(ids, -1))

    def draw_samples(self, points: int, generator: torch.Generator) -> SurfaceSamples:
        """Points spread evenly by area over the clothed template's visible surface."""
        shown = self.shown_faces.cpu()
        samples = sample_surface(self.clothed_vertices.cpu(), self.clothed_faces.cpu()[shown], points, generator)
        return replace(samples, face_ids=shown[samples.face_ids])

    @torch.no_grad()
    def dress(self, batch: Batch) -> tuple[Batch, Tensor]:
        """The batch with what is encoded in place of the body, and the whole template ``(B, V, 3)``, both posed."""
        transforms = skin_transforms(self.clothed_weights[self.seen], batch.joint_transforms, self.bind)
        garment = transform_points(transforms, self.vertices)[:, : self.garment_count]
        whole = torch.cat([batch.vertices[:, self.clothed_body_vertex[: self.skin]], garment], dim=1)
        vertices = whole[:, self.seen]
        seen = transform_points(invert_rigid(batch.joint_transforms[:, :1]), vertices)
        return replace(batch, vertices=vertices, vertex_transforms=transforms, pose_vertices=seen), whole

    def start(self, batch: Batch, samples: SurfaceSamples, wrinkles: bool) -> Decoded:
        """As `TemplateNetwork.start`, with the offsets of the handles: a training frame's own, or those of its pose."""
        bare = self.bare_body(samples)
        if self.handles is None or not wrinkles:
            return bare
        with torch.autocast(bare.offsets.device.type, enabled=False):
            if self.training:
                moved = self.handles(batch.frame_ids)
            else:
                moved = self.handles.predict(handle_poses(batch.joint_transforms, self.config))
            offsets = interpolate(moved, samples) / self.config.offset_scale
        return Decoded(offsets, bare.normals)

    def forward(self, batch: Batch, samples: SurfaceSamples, wrinkles: bool = True) -> Prediction:
        """As `TemplateNetwork.forward`, at points of the clothed template.

        With ``head=mesh`` offsets are those of the garment's vertices and ``mesh`` has the vertices of skin and
        garment; with ``head=points`` offsets are those of the points on the garment.
        """
        encoded, whole = self.dress(batch)
        if self.config.head is Head.mesh:
            found = super().forward(encoded, self.garment_vertices, wrinkles)
            with torch.autocast(found.points.device.type, enabled=False):
                whole = torch.cat([whole[:, : self.skin], found.points], dim=1)
                normals = interpolate(vertex_normals(whole, self.clothed_faces), samples)
                points, normals = interpolate(whole, samples), normalize(normals, dim=-1, eps=1e-20)
            return replace(found, points=points, normals=normals, wrinkle_normals=None, mesh=whole)
        points = interpolate(whole, samples)
        normals = normalize(interpolate(vertex_normals(whole, self.clothed_faces), samples), dim=-1, eps=1e-20)
        rows = (samples.vertex_ids[:, 0] >= self.skin).nonzero()[:, 0]
        ids = samples.vertex_ids[rows] - self.skin
        found = super().forward(encoded, SurfaceSamples(ids, samples.barycentric[rows], ids[:, 0]), wrinkles)
        moved = {
            "points": points.index_copy(1, rows, found.points),
            "normals": normals.index_copy(1, rows, found.normals),
        }
        return replace(found, **moved)


def clothed_template(state: Mapping[str, Tensor]) -> ClothedTemplate:
    """The clothed template that is part of a network's state."""
    return ClothedTemplate(**{name: state[f"clothed_{name}"].cpu().numpy() for name in STATE})


def handle_poses(joint_transforms: Tensor, config: LayeredConfig) -> Tensor:
    """What the handles follow of joint transforms ``(B, J, 4, 4)``: with gravity in the heading frame."""
    return pose_features(joint_transforms, gravity=config.pose_frame is PoseFrame.heading)


def consecutive_frames(names: Sequence[str], poses: Tensor) -> Tensor:
    """Triples ``(T, 3)`` of frames, by index, that follow each other in a motion.

    They are of one sequence (``<sequence>.<number>``), as far apart as its nearest frames are, and no joint turns much
    from one to the next (pose features ``(N, J, 9)``): numbers of random poses follow each other, too.
    """
    numbers: dict[str, dict[int, int]] = {}
    for index, name in enumerate(names):
        number = name.rpartition(".")[2]
        if number.isdecimal():
            numbers.setdefault(sequence_of(name), {})[int(number)] = index
    triples = []
    for frames in numbers.values():
        step = int(np.diff(sorted(frames)).min(initial=1 << 30)) if len(frames) > 2 else 0
        triples += [
            [frames[number - step], index, frames[number + step]]
            for number, index in sorted(frames.items())
            if step and {number - step, number + step} <= frames.keys()
        ]
    found = torch.tensor(triples, dtype=torch.int64).reshape(-1, 3)
    turns = [(poses[found[:, place]] - poses[found[:, place + 1]]).square().mean(dim=-1) for place in (0, 1)]
    return found[(torch.stack(turns).sqrt() < CLOSE).all(dim=2).all(dim=0)]


class LayeredTask(PointTask):
    """Training on points of the clothed template's visible surface, with the terms of its mesh."""

    terms = (*PointTask.terms, *TERMS)

    def __init__(self, model: LayeredAvatar, *rest: Any):
        super().__init__(model, *rest)
        self.cloth = ClothMesh.of_faces(model.garment_faces.cpu()).to(self.device)

    def settle(self) -> None:
        if self.model.handles is not None:
            self.model.handles.fit(self.config.mirror)

    def objective(self, prediction: Prediction, batch: Batch, progress: float) -> LossTerms:
        terms, config = super().objective(prediction, batch, progress), self.model.config.cloth
        if prediction.mesh is None:
            return terms
        cloth, model = self.cloth, self.model
        garment, flat = prediction.mesh[:, model.skin :], model.vertices[: model.garment_count]
        rest = flat + (prediction.offsets if prediction.garment_offsets is None else prediction.garment_offsets)
        measures: dict[str, Callable[[], Tensor]] = {
            "laplacian": lambda: cloth.differences(prediction.offsets).square().sum(dim=-1).mean(),
            "strain": lambda: edge_strain(cloth.edge_lengths(garment), cloth.edge_lengths(rest)),
            "bending": lambda: bending(cloth.angles(garment), cloth.angles(rest) if config.bent_rest else None),
            "body_contact": lambda: body_contact(garment, batch.vertices, model.body_faces, config.gap),
            "self_contact": lambda: self_contact(garment, flat, config.gap, REST_APART),
            "temporal": lambda: model.handles.unsteadiness(),
        }
        weights = {name: getattr(config, name) for name in TERMS if getattr(config, name)}
        raw = {name: measures[name]() for name in weights}
        weighted = {name: value * weights[name] for name, value in raw.items()}
        return LossTerms(terms.raw | raw, terms.weighted | weighted)


class Layered(PointMethod):
    """The layered avatar of one outfit, on the clothed template that its canonicalizer's run has."""

    name = "layered"
    Settings = LayeredConfig
    task = LayeredTask
    on_body = False
    makes_meshes = True
    static: ClassVar[Mapping[str, Any]] = {"pose": False, "handles": 0}

    def check(self, run: RunConfig, settings: LayeredConfig) -> None:
        if len(run.outfit) != 1:
            raise AvatarError(
                f"outfit: expected one, with its template, got {len(run.outfit)}. Hint: train each alone."
            )
        if run.space is not Space.posed or settings.skinning is not Skinning.body:
            got = f"{run.space.value} and {settings.skinning.value}"
            raise AvatarError(f"space, skinning: expected posed and body for layered, got {got}. Hint: leave them out.")

    def needs(self, run: RunConfig, settings: LayeredConfig) -> frozenset[str]:
        return frozenset({CANONICALIZER, CLOTHED_TEMPLATE})

    def build(self, run: RunConfig, settings: LayeredConfig, template: Template, outfits: list[Outfit]) -> nn.Module:
        path = canonicalizer_folder(run.runs_root, outfits[0], run.canonical) / "template" / "template.npz"
        if not path.is_file():
            where = [f"dataset={run.dataset}", f"outfit={run.outfit[0]}", f"canonical={run.canonical}"]
            where += [] if run.runs_root == Path("runs") else [option("runs_root", run.runs_root)]
            command = command_line("template", *where)
            raise DataError(path, "expected a clothed template, there is none.", f"Make it: {command}")
        clothed = read_clothed_template(path)
        if not clothed.garment_faces.any():
            raise DataError(path, "expected a garment, got skin alone.", "Train method=closet on this outfit.")
        handles = None
        if settings.handles:
            frames = split_outfit(outfits[0], run.split).train
            bodies = [outfits[0].load_body("train", name).joint_transforms for name in frames]
            transforms = torch.as_tensor(np.stack(bodies), dtype=torch.float32)
            triples = consecutive_frames(frames, handle_poses(transforms, settings))
            if run.train.mirror:
                joints = mirror_map(template).joints
                transforms = torch.cat([transforms, ACROSS @ transforms[:, joints] @ ACROSS])
                triples = torch.cat([triples, triples + len(frames)])
            garment = clothed.garment
            layout = HandleLayout.on_mesh(*map(torch.from_numpy, garment), settings.handles)
            handles = ClothHandles(layout, handle_poses(transforms, settings), triples)
        return LayeredAvatar(template, clothed, settings, handles)

    def untrained(self, settings: LayeredConfig, template: Template) -> nn.Module:
        arrays = {name: getattr(template, name).numpy() for name in ("vertices", "faces", "weights")}
        count = len(template.vertices)
        clothed = ClothedTemplate(**arrays, body_vertex=np.full(count, -1), covered=np.zeros(count, bool))
        return LayeredAvatar(template, clothed, settings)

    def rebuild(self, settings: Any, template: Template, outfits: int, facts: dict, weights: dict) -> nn.Module:
        handles = None
        if "handles.poses" in weights:  # runs trained before there were handles have none
            layout = HandleLayout(*(weights[f"handles.{name}"] for name in ("ids", "shares", "groups")))
            handles = ClothHandles(layout, weights["handles.poses"])
        return LayeredAvatar(template, clothed_template(weights), settings, handles)

    def predictor(self, avatar: TrainedAvatar, outfit: str, points: int, surface: ExtractionConfig) -> Callable:
        samples = template_samples(avatar, points)
        return lambda body: self.surface(avatar, body, samples)

    @torch.no_grad()
    def surface(self, avatar: TrainedAvatar, body: BodyFit, samples: SurfaceSamples, wrinkles: bool = True) -> Surface:
        """The dressed surface of a body, in points of the template and, with ``head=mesh``, a mesh."""
        device = avatar.model.vertices.device
        found = avatar.model(body_batch([body], 0, ("pose",)).to(device), samples.to(device), wrinkles)
        cloud = join_clouds([found])
        if found.mesh is None:
            return Surface(cloud)
        mesh = Mesh(found.mesh[0].float().cpu().numpy(), avatar.model.clothed_faces.cpu().numpy())
        return Surface(cloud, mesh, constant=True)

    def garment(
        self, avatar: TrainedAvatar, outfit: str, points: int, body: BodyFit | None = None
    ) -> PointCloud | None:
        if not avatar.settings.template:
            return None
        model = avatar.model
        samples = template_samples(avatar, points).to(model.vertices.device)
        if body is not None:
            return self.surface(avatar, body, samples, wrinkles=False).cloud
        found = model.garment_template(0, model.garment_vertices)
        mesh = torch.cat([model.clothed_vertices[: model.skin], found.points[0]])
        normals = normalize(interpolate(vertex_normals(mesh, model.clothed_faces), samples), dim=-1, eps=1e-20)
        return join_clouds([replace(found, points=interpolate(mesh, samples)[None], normals=normals[None])])

    def mesh_template(self, avatar: TrainedAvatar) -> ClothedTemplate | None:
        return clothed_template(avatar.model.state_dict()) if avatar.settings.head is Head.mesh else None

    def fit_code(self, avatar: TrainedAvatar, batch: Batch, options: FitConfig) -> Tensor:
        problem = "run: expected a method whose garment is a code alone, got layered, with a template of its own."
        raise AvatarError(f"{problem} Hint: train the new outfit by itself.")
