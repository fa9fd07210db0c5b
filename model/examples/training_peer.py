"""The same training steps in PyTorch: `training_peer.py PRESET WINDOWS THREADS`, with the protocol of `training_step.rs`."""

import resource
import sys
import time

import torch
import torch.nn as nn
import torch.nn.functional as F

PRESETS = {
    "grnet": dict(width=1.0, side=224, hidden=1000, fc=1024, rotation=4, flatten=None),
    "grnet-small": dict(width=0.25, side=112, hidden=128, fc=128, rotation=6, flatten=32),
}
K = 5


class ConvBn(nn.Module):
    def __init__(self, inputs, outputs, kernel, stride):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
        self.bn = nn.BatchNorm2d(outputs)

    def forward(self, x):
        return self.bn(self.conv(x))


class Bottleneck(nn.Module):
    def __init__(self, inputs, planes, stride):
        super().__init__()
        self.one = ConvBn(inputs, planes, 1, 1)
        self.two = ConvBn(planes, planes, 3, stride)
        self.three = ConvBn(planes, 4 * planes, 1, 1)
        changes = stride != 1 or inputs != 4 * planes
        self.shortcut = ConvBn(inputs, 4 * planes, 1, stride) if changes else nn.Identity()

    def forward(self, x):
        y = F.elu(self.one(x), inplace=True)
        y = F.elu(self.two(y), inplace=True)
        return F.elu(self.three(y).add_(self.shortcut(x)), inplace=True)


def stage(inputs, planes, blocks, stride):
    first = Bottleneck(inputs, planes, stride)
    return nn.Sequential(first, *(Bottleneck(4 * planes, planes, 1) for _ in range(blocks - 1)))


class Branch(nn.Module):
    def __init__(self, inputs, channels, c):
        super().__init__()
        self.res5 = stage(inputs, channels(512), 3, 2)
        side = -(-c["side"] // 32)
        self.reduce = ConvBn(4 * channels(512), c["flatten"], 1, 1) if c["flatten"] else None
        features = c["flatten"] * side * side if c["flatten"] else 4 * channels(512)
        self.lstm = nn.LSTM(features, c["hidden"], num_layers=2, batch_first=True)
        self.fc = nn.Linear(c["hidden"], c["fc"])

    def forward(self, x, windows):
        y = self.res5(x)
        y = F.elu(self.reduce(y), inplace=True).flatten(1) if self.reduce else y.mean((2, 3))
        y, _ = self.lstm(y.unflatten(0, (windows, -1)))
        return self.fc(y.flatten(0, 1))


class Head(nn.Module):
    def __init__(self, c):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(c["fc"], n) for n in (3, c["rotation"], 6))

    def forward(self, x):
        return [layer(x) for layer in self.layers]


class Network(nn.Module):
    def __init__(self, c):
        super().__init__()
        channels = lambda at_width_1: max(1, int(at_width_1 * c["width"] / 8 + 0.5)) * 8
        self.stem = ConvBn(3, channels(64), 7, 2)
        self.layers = nn.Sequential(
            stage(channels(64), channels(64), 3, 1),
            stage(4 * channels(64), channels(128), 4, 2),
            stage(4 * channels(128), channels(256), 6, 2),
        )
        features = 4 * channels(256)
        self.rcnn1 = Branch(2 * features, channels, c)
        self.rcnn2 = Branch(features, channels, c)
        self.fc3 = nn.Linear(2 * c["fc"], c["fc"])
        self.heads = nn.ModuleList(Head(c) for _ in range(3))

    def forward(self, images):
        windows = images.shape[0]
        x = F.max_pool2d(F.elu(self.stem(images.flatten(0, 1)), inplace=True), 3, 2, 1)
        x = self.layers(x)
        by_window = x.unflatten(0, (windows, -1))
        previous = torch.cat([by_window[:, :1], by_window[:, :-1]], 1).flatten(0, 1)
        fc1 = self.rcnn1(torch.cat([previous, x], 1), windows)
        fc2 = self.rcnn2(x, windows)
        fc3 = self.fc3(torch.cat([fc1, fc2], 1))
        return [y for head, fc in zip(self.heads, (fc1, fc2, fc3)) for y in head(fc)]


def main():
    preset, windows, threads = sys.argv[1:]
    torch.set_num_threads(int(threads))
    torch.manual_seed(7)
    c = PRESETS[preset]
    network = Network(c).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-5, fused=True)
    images = torch.rand(int(windows), K, 3, c["side"], c["side"]) * 2 - 1
    for _ in sys.stdin:
        wall, cpu = time.perf_counter(), time.process_time()
        optimizer.zero_grad(set_to_none=True)
        sum(y.square().mean() for y in network(images)).backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        assert torch.isfinite(norm)
        optimizer.step()
        wall, cpu = (time.perf_counter() - wall) * 1e3, (time.process_time() - cpu) * 1e3
        print(f"{wall:.2f} {cpu:.2f} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}", flush=True)


if __name__ == "__main__":
    main()
