"""Trains a built-in network, or its prefilter, with PyTorch, on a GPU that is lent for minutes or on a CPU.

    python train.py --model prefilter --data train*.pack --val dev.pack --minutes 3 --out prefilter
    python train.py --model demc-m --prefilter prefilter/last.safetensors --data train*.pack --val dev.pack \\
        --minutes 10 --out run

The folder holds last.safetensors (averaged weights, which the crate reads), log.csv, and checkpoint.pt, from
which --resume goes on with the same command. The learning rate falls linearly over --steps, or over
--minutes where those are given. A run ends with whichever is over first, and always saves. `demc train
--init` measures the ranges that 8-bit arithmetic needs.
"""

import argparse
import copy
import csv
import os
import random
import sys
import time

import torch

import losses
import network
from data import LEAST, Frames
from optimizer import Optimizer

_WARM_UP = 100
# Validation errors below this count as this: a black frame that is exact would outweigh all others.
_LEAST_RELMSE = 1e-6


def parse():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=[*network.SIZES, "prefilter"], default="demc-m")
    parser.add_argument("--size-of", choices=network.SIZES, default="demc-m", help="whose prefilter to train")
    parser.add_argument("--data", nargs="+", required=True, metavar="PACK")
    parser.add_argument("--val", nargs="*", default=[], metavar="PACK", help="never trained on")
    parser.add_argument("--out", required=True, metavar="DIR")
    parser.add_argument("--init", metavar="WEIGHTS", help="begin with these weights")
    parser.add_argument("--prefilter", metavar="WEIGHTS", help="a trained prefilter, or a network that has one")
    parser.add_argument("--learn-guides", action="store_true", help="train the prefilter along with the network")
    parser.add_argument("--steps", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=0)
    parser.add_argument("--patch", type=int, default=128)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--lr", type=lambda text: tuple(map(float, text.split(":"))), default=(3e-3, 1e-6))
    parser.add_argument("--weight-decay", type=float, default=0.2)
    parser.add_argument("--average", type=float, default=0.998)
    parser.add_argument("--loss", choices=losses.LOSSES, default="ssim")
    parser.add_argument("--raw-references", action="store_true", help="see `demc train --help`")
    parser.add_argument("--guide-dropout", type=float, default=0.0, metavar="SHARE", help="see `demc train --help`")
    parser.add_argument("--leak", type=float, default=0.0, metavar="SHARE", help="see `demc train --help`")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=float, default=60, metavar="S", help="seconds between validations")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--f32", action="store_true", help="no bfloat16 in convolutions")
    parser.add_argument("--resume", action="store_true")
    options = parser.parse_args()
    if not (options.steps or options.minutes):
        parser.error("give --steps, --minutes or both")
    if options.guide_dropout and options.model == "prefilter":
        parser.error("--guide-dropout is for networks: a prefilter without guides has nothing to do")
    if options.patch % 16:
        parser.error("--patch must be a multiple of 16")
    return options


def make(options):
    """The network, and which of its parameters learn."""
    torch.manual_seed(options.seed)
    if options.model == "prefilter":
        net = network.Prefilter(network.SIZES[options.size_of]["prefilter"])
    else:
        net = network.Pyramid(**network.SIZES[options.model])
    if options.init:
        begun, _ = network.read(options.init)
        net.load_state_dict(begun.state_dict())
    if options.prefilter and options.model != "prefilter":
        begun, _ = network.read(options.prefilter)
        net.prefilter.load_state_dict(getattr(begun, "prefilter", begun).state_dict())
    if options.model != "prefilter" and not options.learn_guides:
        for parameter in net.prefilter.parameters():
            parameter.requires_grad = False
    net.set_leak(options.leak)
    for part in net.modules():
        part.narrow = not options.f32
    return net.to(options.device, memory_format=torch.channels_last)


@torch.no_grad()
def validate(net, frames, options):
    """Geometric mean of RelMSE and mean SSIM over whole frames, by sample count."""
    found = {}
    for index in range(len(frames)):
        frame = frames.whole(index)
        image, exposed = net(frame["noisy"], options.learn_guides)
        image, reference = image / exposed, net.target(frame["reference"], frame.get("guides"))
        error = losses.relmse(image, reference).clamp(min=_LEAST_RELMSE).log().item()
        ssim = losses.displayed_ssim(image, reference).item() if net.makes_radiance else float("nan")
        found.setdefault(frame["spp"], []).append((error, ssim))

    def mean(values):
        relmse, ssim = (sum(v) / len(v) for v in zip(*values))
        return torch.tensor(relmse).exp().item(), ssim

    by_count = {spp: mean(values) for spp, values in sorted(found.items())}
    return mean([v for values in found.values() for v in values]) if found else None, by_count


def follow(average, net, decay, step):
    """Moves the averaged weights towards the current ones, faster in the first steps."""
    decay = min(decay, (1 + step) / (10 + step))
    with torch.no_grad():
        for kept, current in zip(average.parameters(), net.parameters()):
            kept.lerp_(current, 1 - decay) if current.requires_grad else kept.copy_(current)


def facts(options, config, step, seconds, frames, validation, score):
    """The metadata of a weights file, as the crate reads it."""
    training = {
        "frames": frames, "steps": step, "batch": options.batch, "patch": options.patch, "lr": list(options.lr),
        "loss": options.loss, "raw_references": options.raw_references, "guide_dropout": options.guide_dropout, "leak": options.leak,
        "optimizer": "muon", "weight_decay": options.weight_decay, "precision": "f32" if options.f32 else "bf16",
        "average": options.average, "seed": options.seed, "init": options.init, "prefilter": options.prefilter,
        "only": [], "seconds": seconds, "validation_frames": validation,
        "validation_relmse": score and score[0], "validation_ssim": score and score[1],
    }  # fmt: skip
    if score and score[1] != score[1]:
        training["validation_ssim"] = None
    return {"network": config, "inputs": network.INPUTS, "training": training}


def main():
    start = saved = time.time()  # the minutes given hold whatever is done before the first step too
    options = parse()
    os.makedirs(options.out, exist_ok=True)
    net = make(options)
    average = copy.deepcopy(net)
    optimizer = Optimizer(net.parameters(), net.hidden(), options.weight_decay)
    needs_guides = not net.makes_radiance
    frames = Frames(options.data, options.device, options.patch, needs_guides)
    validation = Frames(options.val, options.device, LEAST, needs_guides)
    if not len(frames):
        what = " whose references keep their guides" if needs_guides else ""
        sys.exit(f"train.py: no pair of {options.patch}x{options.patch} pixels or more{what}; pack others")
    if shared := validation.references() & frames.references():
        sys.exit(f"train.py: {len(shared)} views of --val are among those of --data: pack others, or name packs apart")
    rng, step, before, pixels = random.Random(options.seed), 0, 0.0, 0
    checkpoint = os.path.join(options.out, "checkpoint.pt")
    if options.resume and os.path.exists(checkpoint):
        kept = torch.load(checkpoint, map_location=options.device, weights_only=False)
        net.load_state_dict(kept["net"])
        average.load_state_dict(kept["average"])
        optimizer.load(kept["optimizer"])
        rng.setstate(kept["rng"])
        step, before, pixels = kept["step"], kept["seconds"], kept["pixels"]
    log = os.path.join(options.out, "log.csv")
    if not (options.resume and os.path.exists(log)):
        with open(log, "w", encoding="utf-8") as file:
            file.write("step,seconds,megapixels,lr,loss,val_relmse,val_ssim\n")
    total, counted, skipped = 0.0, 0, 0
    print(f"{len(frames)} pairs, {len(validation)} to validate, {options.device}, from step {step}", flush=True)

    def save():
        nonlocal saved, total, counted
        score, by_count = validate(average, validation, options)
        seconds = before + time.time() - start
        row = [step, f"{seconds:.1f}", f"{pixels / 1e6:.2f}", f"{lr:.3g}", f"{total / max(counted, 1):.5f}"]
        row += [f"{score[0]:.6g}", f"{score[1]:.5f}"] if score else ["", ""]
        with open(log, "a", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(row)
        print(*row, " ".join(f"{spp}: {r:.4g} {s:.4f}" for spp, (r, s) in by_count.items()), flush=True)
        described = facts(options, net.config(), step, seconds, len(frames), len(validation), score)
        network.write(os.path.join(options.out, "last.safetensors"), average, described)
        state = {"net": net.state_dict(), "average": average.state_dict(), "optimizer": optimizer.state()}
        state |= {"rng": rng.getstate(), "step": step, "seconds": seconds, "pixels": pixels}
        torch.save(state, f"{checkpoint}.tmp")
        os.replace(f"{checkpoint}.tmp", checkpoint)
        saved, total, counted = time.time(), 0.0, 0

    lr, began = options.lr[0], step
    while True:
        elapsed = before + time.time() - start
        done = max(
            step / options.steps if options.steps else 0, elapsed / 60 / options.minutes if options.minutes else 0
        )
        if done >= 1:
            break
        lr = options.lr[0] + (options.lr[1] - options.lr[0]) * done
        lr *= min(1, (step + 1) / _WARM_UP)
        noisy, reference, raw, guides = frames.draw(rng, options.batch, options.patch, options.guide_dropout)
        image, exposed = net(noisy, options.learn_guides)
        target = net.target(reference, guides) * exposed
        raw = raw * exposed if options.raw_references and net.makes_radiance else None
        loss = losses.LOSSES[options.loss](image.float(), target, raw, exposed)
        optimizer.zero()
        loss.backward()
        if not optimizer.step(lr):
            skipped += 1
            if skipped > 100:
                sys.exit("train.py: no finite gradient in 100 steps; take a lower --lr")
            continue
        skipped = 0
        follow(average, net, options.average, step)
        step, pixels = step + 1, pixels + options.batch * options.patch**2
        total, counted = total + loss.item(), counted + 1
        if time.time() - saved > options.every:
            save()
    if step > began or step == 0:
        save()
    print(f"{pixels / 1e6 / max(before + time.time() - start, 1e-9):.3f} Mpx/s")


if __name__ == "__main__":
    main()
