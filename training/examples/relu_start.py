"""relu_start.py RECORDING OUT [STEPS]: a ResNet-50 of ReLUs with torchvision's names, trained on the poses of a recording, as safetensors.

Stands in for public ImageNet weights where no network is: what matters for the importer is that they were trained with ReLU.
"""

import pathlib
import sys

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import nn

SIDE, BATCH = 64, 24


class Bottleneck(nn.Module):
    def __init__(self, inputs, width, stride):
        super().__init__()
        outputs = 4 * width
        self.conv1, self.bn1 = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.downsample = None
        if stride > 1 or inputs != outputs:
            projection = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(projection, nn.BatchNorm2d(outputs))

    def forward(self, x):
        y = torch.relu(self.bn1(self.conv1(x)))
        y = torch.relu(self.bn2(self.conv2(y)))
        shortcut = x if self.downsample is None else self.downsample(x)
        return torch.relu(self.bn3(self.conv3(y)) + shortcut)


class ResNet50(nn.Module):
    def __init__(self, outputs):
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64)
        inputs = 64
        for number, (width, blocks, stride) in enumerate([(64, 3, 1), (128, 4, 2), (256, 6, 2), (512, 3, 2)], 1):
            layer = []
            for block in range(blocks):
                layer.append(Bottleneck(inputs, width, stride if block == 0 else 1))
                inputs = 4 * width
            setattr(self, f"layer{number}", nn.Sequential(*layer))
        self.fc = nn.Linear(inputs, outputs)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x):
        x = nn.functional.max_pool2d(torch.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        for number in range(1, 5):
            x = getattr(self, f"layer{number}")(x)
        return self.fc(x.mean((2, 3)))


def recording(folder):
    """Images as the importer's network expects them, and positions and two axes of the camera, each of about unit spread."""
    files = sorted(pathlib.Path(folder).glob("seq-*/*.color.jpg"))
    pixels = [np.asarray(Image.open(file).resize((SIDE, SIDE), Image.Resampling.BOX)) for file in files]
    images = (np.stack(pixels) / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    poses = np.array([np.loadtxt(str(file).replace(".color.jpg", ".pose.txt")) for file in files])
    positions = poses[:, :3, 3]
    positions = (positions - positions.mean(0)) / positions.std(0)
    targets = np.concatenate([positions, 2 * poses[:, :3, 2], 2 * poses[:, :3, 0]], 1)
    as_tensor = lambda array: torch.tensor(array, dtype=torch.float32)
    return as_tensor(images).permute(0, 3, 1, 2), as_tensor(targets)


def main():
    folder, out = sys.argv[1:3]
    steps = int(sys.argv[3]) if len(sys.argv) > 3 else 160
    torch.manual_seed(1)
    images, targets = recording(folder)
    network = ResNet50(targets.shape[1])
    adam = torch.optim.Adam(network.parameters())
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = 1e-3 * min(1, (step + 1) / 20) * (1 - step / steps)
        chosen = torch.randint(0, len(images), (BATCH,))
        loss = (network(images[chosen]) - targets[chosen]).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        if step % 40 == 0 or step == steps - 1:
            print(f"ReLU, PyTorch: step {step + 1} of {steps}, mean error {loss.item():.3f}", flush=True)
    save_file({name: value.contiguous() for name, value in network.state_dict().items()}, out)


main()
