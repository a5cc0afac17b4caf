"""What every process of the tests' team does: ``torchrun team.py <folder> <steps>``; alone without torchrun."""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path

import torch
from torch import nn

sys.path.insert(0, str(Path(__file__).parents[1]))
from cut_sphere import ATLASED
from spheres import ENCODER, TEMPLATE, random_batch, small_config

from avatar.methods.closet import ClosetAvatar, ClosetConfig
from avatar.methods.losses import LossConfig, point_avatar_loss
from avatar.methods.points import PointTask
from avatar.methods.pop import PopAvatar, PopConfig
from avatar.methods.settings import TrainConfig
from avatar.nn.decoders import DecoderConfig
from avatar.nn.layers import PointNorm, synchronize_norms
from avatar.nn.unet import UNetConfig
from avatar.records import Batch, Template
from avatar.training.trainer import Trainer
from avatar.world import World, current_world, gather, torchrun_world

FRAMES, ALL = 4, slice(None)
SHARES = {  # outfits of the four frames of a step, of which each process has two
    "each outfit in one process": (0, 0, 1, 1),
    "both outfits in both processes": (0, 1, 1, 0),
    "one outfit in both, one in one": (1, 0, 0, 0),
    "one of the two outfits": (1, 1, 1, 1),
}


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
    torch.manual_seed(5 + current_world().rank)
    model = ClosetAvatar(TEMPLATE, 1, small_config()).double()
    defaults = {"points": 60, "scan_points": 50, "batch": FRAMES, "log_every": 1, "fresh_points": True, "lr": 3e-4}
    loss = LossConfig(normal_start=0.04)  # from the second step, whether the budget ends at 12 or at 20
    config = TrainConfig(steps=steps, save_every=6, validate_every=8, loss=loss, **(defaults | options))
    return trainer_of(model, TEMPLATE, config, folder)


def trainer_of(model: nn.Module, template: Template, config: TrainConfig, folder: Path) -> Trainer:
    """A point method's trainer, its batches still to be given."""
    return Trainer(PointTask(model, template, config, batch_of, 2 * FRAMES), config, folder)


def fit(trainer: Trainer, world: World) -> None:
    """Trains on this process's shares; three validation batches do not share out evenly among two."""
    checks = [part(random_batch(frames, (0,) * frames)) for frames in (2, 1, 2)]
    trainer.task.batch_at = lambda step: part(batch_of(step), world.shard(FRAMES))
    trainer.task.validation = lambda: checks
    trainer.fit()


def norm_errors(world: World) -> list[float]:
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
        synchronize_norms(twin)
        rows = slice(0, 2) if world.rank == 0 else slice(2, 8)  # unequal shares
        whole, mine = features.clone().requires_grad_(), features[rows].clone().requires_grad_()
        expected, found = model(whole), twin(mine)
        (expected * weights).sum().backward()
        (found * weights[rows]).sum().backward()
        scale = sum(each for each in gather(twin[0].weight.grad, world))
        errors += [float((found - expected[rows]).abs().max()), float((mine.grad - whole.grad[rows]).abs().max())]
        errors += [float((scale - layer.weight.grad).abs().max() / scale.abs().max())]
        for name in ("running_mean", "running_var"):
            errors.append(float((twin.state_dict()[f"0.{name}"] - model.state_dict()[f"0.{name}"]).abs().max()))
        model.eval(), twin.eval()
        errors.append(float((twin(mine) - model(whole)[rows]).abs().max()))
    return errors


def two_outfits(method: str) -> nn.Module:
    """A small network of two outfits whose garment branch has normalisations; in training mode, double precision."""
    torch.manual_seed(3)
    decoder = DecoderConfig(width=16, trunk=1, branch=1)
    if method == "closet":
        return ClosetAvatar(TEMPLATE, 2, ClosetConfig(ENCODER, ENCODER, decoder, decoder, 6, code_std=1.0)).double()
    config = PopConfig(UNetConfig(3, 4, 6), decoder, decoder, map_size=32, code_channels=5, code_std=1.0, template=True)
    return PopAvatar(ATLASED, 2, config).double()


def outfit_errors(folder: Path, world: World) -> dict[str, float]:
    """Largest differences of a team's gradients and statistics from those of one process, as shares of their norm."""
    errors, loss = {}, LossConfig(normal_start=0.0, offset=20.0, wrinkle=20.0, wrinkle_normal=1.0, code=10.0)
    config = TrainConfig(batch=FRAMES, points=60, scan_points=50, loss=loss)
    for method in ("closet", "pop"):
        for case, outfits in SHARES.items():
            whole, alone = part(random_batch(FRAMES, outfits)), two_outfits(method)
            trainer = trainer_of(two_outfits(method), TEMPLATE, config, folder)
            terms, _, norm = trainer.train_step((part(whole, world.shard(FRAMES)), trainer.task.samples_at(0)))
            expected = point_avatar_loss(alone(whole, trainer.task.samples_at(0)), whole, loss, 0.0)
            expected.total.backward()
            logged = trainer.world_mean({name: float(value.detach()) for name, value in terms.raw.items()})
            wanted, found = dict(alone.named_parameters()), dict(trainer.model.named_parameters())
            length = torch.stack([parameter.grad.norm() for parameter in wanted.values()]).norm()
            worst = {name: (found[name].grad - wanted[name].grad).norm() / length for name in wanted}
            worst |= {name: abs(logged[name] - float(value.detach())) for name, value in expected.raw.items()}
            for name, value in alone.named_buffers():
                worst[name] = (trainer.model.get_buffer(name).double() - value).abs().max()
            worst["norm"] = (norm - length).abs() / length
            errors[f"{method}, {case}"] = max(float(error) for error in worst.values())
    return errors


def norms_after_a_bad_frame(folder: Path, world: World) -> list[float]:
    """Gradient norms of two steps of two outfits, the first with a body of one process that is not finite."""
    whole, config = part(random_batch(FRAMES, (0, 1, 0, 1))), TrainConfig(batch=FRAMES, points=60, scan_points=50)
    broken = replace(whole, vertices=whole.vertices.clone())
    broken.vertices[-1] = torch.nan
    trainer = trainer_of(two_outfits("closet"), TEMPLATE, config, folder)
    return [
        float(trainer.train_step((part(batch, world.shard(FRAMES)), trainer.task.samples_at(0)))[2])
        for batch in (broken, whole)
    ]


def main(folder: Path, steps: int) -> None:
    with torchrun_world() as world:
        facts = {"rank": world.rank, "size": world.size}
        if world.size > 1 and steps == 20:
            facts["norms"] = norm_errors(world)
            facts["outfits"] = outfit_errors(folder, world)
            facts["bad"] = norms_after_a_bad_frame(folder, world)
        trainer = make_trainer(folder, steps)
        fit(trainer, world)
        weights = [float(value.double().sum()) for value in trainer.model.state_dict().values()]
        facts["agree"] = all(other == weights for other in gather(weights, world))
        facts["seconds"] = gather(trainer.seconds, world)
        (folder / f"facts-{world.rank}.json").write_text(json.dumps(facts))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]), int(sys.argv[2]))
