"""What every process of the tests' team does: ``torchrun team.py <folder> <steps>``; alone without torchrun."""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path

import torch
from torch import nn

sys.path.insert(0, str(Path(__file__).parents[1]))
from spheres import TEMPLATE, random_batch, small_config

from avatar.nn.closet import ClosetAvatar
from avatar.nn.pointnet2 import PointNorm
from avatar.records import Batch
from avatar.training.distributed import Team, current_team, gather, share_norms, torchrun_team
from avatar.training.loop import TrainConfig, Trainer
from avatar.training.losses import LossConfig

FRAMES, ALL = 4, slice(None)


def part(batch: Batch, frames: slice = ALL) -> Batch:
    """Some frames of a batch as rounding leaves them alone: for a network in double precision, with scans of one
    normal, so that a nearest neighbour that changes over a tie changes nothing."""
    values = {field.name: getattr(batch, field.name) for field in fields(batch)}
    cut = {k: v[frames] if isinstance(v, (torch.Tensor, tuple)) else v for k, v in values.items()}
    cut["scan_normals"] = torch.full_like(cut["scan_normals"], 3**-0.5)
    return Batch(**cut | {"pose_vertices": cut["pose_vertices"].double()})


def batch_of(step: int) -> Batch:
    """Four frames of one outfit that change from step to step."""
    batch = random_batch(FRAMES, (0,) * FRAMES)
    generator = torch.Generator().manual_seed(step)
    return replace(batch, scan_points=batch.scan_points + torch.randn(FRAMES, 1, 3, generator=generator))


def make_trainer(folder: Path, steps: int, **options) -> Trainer:
    """A small avatar's training; the same weights in every process only because they are sent around."""
    torch.manual_seed(5 + current_team().rank)
    model = ClosetAvatar(TEMPLATE, 1, small_config()).double()
    defaults = {"points": 60, "scan_points": 50, "batch": FRAMES, "log_every": 1, "fresh_points": True, "lr": 3e-4}
    loss = LossConfig(normal_start=0.0)  # a millionth of a gradient is lost in rounding, and Adam makes steps of it
    config = TrainConfig(steps=steps, save_every=6, validate_every=8, loss=loss, **(defaults | options))
    return Trainer(model, TEMPLATE.vertices, TEMPLATE.faces, config, folder)


def fit(trainer: Trainer, team: Team) -> None:
    """Trains on this process's shares; three validation batches do not share out evenly among two."""
    checks = [part(random_batch(frames, (0,) * frames)) for frames in (2, 1, 2)]
    trainer.fit(lambda step: part(batch_of(step), team.share(FRAMES)), 2, lambda: iter(checks))


def norm_errors(team: Team) -> list[float]:
    """Largest differences of the shared norms' outputs, gradients and statistics from those of one process."""
    errors = []
    for layer, shape in ((PointNorm(5), (8, 7, 5)), (nn.BatchNorm2d(5), (8, 5, 3, 4))):
        torch.manual_seed(0)
        features = torch.randn(shape) * 3 + 40  # a large mean: sums of squares would cancel
        weights = torch.randn(shape)
        nn.init.normal_(layer.weight)
        model = nn.Sequential(layer)
        twin = nn.Sequential(type(layer)(5))
        twin.load_state_dict(model.state_dict())
        share_norms(twin)
        rows = slice(0, 2) if team.rank == 0 else slice(2, 8)  # unequal shares
        whole, mine = features.clone().requires_grad_(), features[rows].clone().requires_grad_()
        expected, found = model(whole), twin(mine)
        (expected * weights).sum().backward()
        (found * weights[rows]).sum().backward()
        scale = sum(each for each in gather(twin[0].weight.grad, team))
        errors += [float((found - expected[rows]).abs().max()), float((mine.grad - whole.grad[rows]).abs().max())]
        errors += [float((scale - layer.weight.grad).abs().max() / scale.abs().max())]
        for name in ("running_mean", "running_var"):
            errors.append(float((twin.state_dict()[f"0.{name}"] - model.state_dict()[f"0.{name}"]).abs().max()))
        model.eval(), twin.eval()
        errors.append(float((twin(mine) - model(whole)[rows]).abs().max()))
    return errors


def main(folder: Path, steps: int) -> None:
    with torchrun_team() as team:
        facts = {"rank": team.rank, "size": team.size}
        if team.size > 1 and steps == 20:
            facts["norms"] = norm_errors(team)
        trainer = make_trainer(folder, steps)
        fit(trainer, team)
        weights = [float(value.double().sum()) for value in trainer.model.state_dict().values()]
        facts["agree"] = all(other == weights for other in gather(weights, team))
        facts["seconds"] = gather(trainer.seconds, team)
        (folder / f"facts-{team.rank}.json").write_text(json.dumps(facts))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]), int(sys.argv[2]))
