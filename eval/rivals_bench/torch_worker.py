"""PyTorch's side: a training step and inference of the base-16 network, channels last."""

import argparse

import torch
from torch import nn

import network
from protocol import serve


class Demc(nn.Module):
    def __init__(self):
        super().__init__()
        conv, self.norms = {}, nn.ModuleDict()
        for name, kind, inputs, outputs in network.layers():
            key = name.replace(".", "_")
            if kind == "up":
                conv[key] = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1)
            else:
                size = 1 if kind == "1x1" else 3
                conv[key] = nn.Conv2d(inputs, outputs, size, padding=size // 2)
            if kind == "norm":
                self.norms[key] = nn.BatchNorm2d(outputs)
        self.convs = nn.ModuleDict(conv)

    def layer(self, name, x):
        key = name.replace(".", "_")
        x = self.convs[key](x)
        if key in self.norms:
            x = self.norms[key](x)
        return torch.relu(x)

    def encode(self, name, x):
        skips = []
        for level in range(len(network.WIDTHS)):
            for unit in range(3):
                x = self.layer(f"{name}.{level}.{unit}", x)
            skips.append(x)
            x = nn.functional.max_pool2d(x, 2)
        return skips, x

    def forward(self, colour, features):
        x = features
        for i in range(4):
            x = self.layer(f"fusion.{i}", x)
        of_features, _ = self.encode("feature", x)
        of_colour, x = self.encode("colour", colour)
        for level in reversed(range(len(network.WIDTHS))):
            up = self.layer(f"up.{level}", x)
            x = self.layer(f"fuse.{level}", torch.cat([up, of_features[level], of_colour[level]], 1))
        return self.layer("output", x) ** network.GAMMA


def inputs(n, height, width):
    last = torch.channels_last
    sizes = ((n, channels, height, width) for channels in (network.COLOUR, network.FEATURES))
    return [torch.rand(*size).to(memory_format=last) for size in sizes]


def model():
    torch.manual_seed(1)
    return Demc().to(memory_format=torch.channels_last)


def train(n, size, bf16):
    net = model().train()
    # What demc's step does too: a bias that keeps the last ReLU alive.
    nn.init.constant_(net.convs["output"].bias, 0.2)
    colour, features = inputs(n, size, size)
    reference = torch.full((n, 3, size, size), 0.5)
    adam = torch.optim.Adam(net.parameters(), lr=1e-5)

    def step():
        adam.zero_grad(set_to_none=True)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            image = net(colour, features)
        loss = ((image.float() - reference) ** 2 / (reference**2 + 0.001)).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        adam.step()

    return step


def infer(height, width, bf16):
    net = model().eval()
    colour, features = inputs(1, height, width)

    def run():
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            net(colour, features)

    return run


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--small", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    crops = (2, 32) if args.small else (8, 128)
    size = (96, 160) if args.small else (736, 1280)
    jobs = {}
    for bf16 in (False, True):
        name = "bf16" if bf16 else "f32"
        jobs[f"train base16 {name}"] = lambda bf16=bf16: train(*crops, bf16)
        jobs[f"infer base16 {name}"] = lambda bf16=bf16: infer(*size, bf16)
    count = sum(p.numel() for p in Demc().parameters())
    serve(jobs, {"program": f"torch {torch.__version__}", "parameters": count})


if __name__ == "__main__":
    main()
