"""Writes the golden files of this folder: `python generate.py` (PyTorch, NumPy, safetensors).

An implementation of the network of its own, written against the paper and PyTorch's operators (functional, `nn.LSTM` for
the recurrence), which shares nothing with the crate. Weights and images come from a formula that the tests compute as
well (`tests/common/formula.rs`), so that only outputs are stored, and of large tensors only every n-th value.
"""

import json
import math
import pathlib

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

HERE = pathlib.Path(__file__).parent
SAMPLES = 256

# --- the formula ----------------------------------------------------------------------------------------------------


def uniform(name, count, low, high):
    """`count` numbers in [low, high): FNV-1a of the name, then SplitMix64 by index, 53 bits, rounded to f32."""
    seed = 0xCBF29CE484222325
    for byte in name.encode():
        seed = ((seed ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    unit = (z >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return (low + unit * (high - low)).astype(np.float32)


def weight(name, shape):
    """The weight of that name: He-uniform convolutions, PyTorch's bounds elsewhere, lively batch norms."""
    suffix = name.rsplit(".", 1)[1]
    if len(shape) == 4:
        bound = math.sqrt(6.0 / (shape[1] * shape[2] * shape[3]))
        low, high = -bound, bound
    elif ".lstm." in name:
        bound = 1.0 / math.sqrt(shape[0] // 4)
        low, high = -bound, bound
    elif len(shape) == 2:
        bound = 1.0 / math.sqrt(shape[1])
        low, high = -bound, bound
    elif suffix == "running_var":
        low, high = 0.6, 1.4
    elif suffix == "weight":
        low, high = 0.4, 0.8
    else:
        low, high = -0.2, 0.2
    return torch.from_numpy(uniform(name, math.prod(shape), low, high).reshape(shape))


def frame(t, height, width):
    """Image number t, (1, 3, height, width): noise of changing strength and brightness."""
    strength = [1.0, 0.3, 1.8, 0.8][t % 4]
    offset = 0.2 * t - 0.3
    values = uniform(f"image.{t}", 3 * height * width, offset - strength, offset + strength)
    return torch.from_numpy(values.reshape(1, 3, height, width))


# --- the network ----------------------------------------------------------------------------------------------------


class Weights:
    """Tensors by name, made on first use; the shape is stated where it is used.

    Those that `trained` holds for take part in gradients; batch norms among them use the statistics of the batch, which
    `statistics` keeps as (mean, unbiased variance).
    """

    def __init__(self, trained=lambda name: False):
        self.made, self.trained, self.statistics = {}, trained, {}

    def __call__(self, name, *shape):
        if name not in self.made:
            made = weight(name, shape).to(torch.get_default_dtype())
            self.made[name] = made.requires_grad_(self.trained(name) and ".running_" not in name)
        assert tuple(self.made[name].shape) == shape, name
        return self.made[name]


def batch_norm(w, x, name):
    c = x.shape[1]
    mean, var = w(f"{name}.running_mean", c), w(f"{name}.running_var", c)
    trained = w.trained(name)
    if trained:
        mean, var = w.statistics[name] = mean.clone(), var.clone()
    # Momentum 1 leaves the statistics of the batch in the running ones.
    scale, shift = w(f"{name}.weight", c), w(f"{name}.bias", c)
    return F.batch_norm(x, mean, var, scale, shift, training=trained, momentum=1.0, eps=1e-5)


def conv_bn(w, x, conv, bn, outputs, kernel, stride):
    y = F.conv2d(x, w(f"{conv}.weight", outputs, x.shape[1], kernel, kernel), stride=stride, padding=kernel // 2)
    return batch_norm(w, y, bn)


def bottleneck(w, x, name, planes, stride):
    y = F.elu(conv_bn(w, x, f"{name}.conv1", f"{name}.bn1", planes, 1, 1))
    y = F.elu(conv_bn(w, y, f"{name}.conv2", f"{name}.bn2", planes, 3, stride))
    y = conv_bn(w, y, f"{name}.conv3", f"{name}.bn3", 4 * planes, 1, 1)
    if stride != 1 or x.shape[1] != 4 * planes:
        x = conv_bn(w, x, f"{name}.downsample.0", f"{name}.downsample.1", 4 * planes, 1, stride)
    return F.elu(x + y)


def stage(w, x, name, planes, blocks, stride):
    for i in range(blocks):
        x = bottleneck(w, x, f"{name}.{i}", planes, stride if i == 0 else 1)
    return x


def stem(w, x, channels):
    y = F.elu(conv_bn(w, x, "cnn1.conv1", "cnn1.bn1", channels, 7, 2))
    return F.max_pool2d(y, kernel_size=3, stride=2, padding=1)


def channels(config, at_width_1):
    return max(1, math.floor(at_width_1 * config["width"] / 8 + 0.5)) * 8


def cnn1(w, config, image):
    x = stem(w, image, channels(config, 64))
    x = stage(w, x, "cnn1.layer1", channels(config, 64), 3, 1)
    x = stage(w, x, "cnn1.layer2", channels(config, 128), 4, 2)
    return stage(w, x, "cnn1.layer3", channels(config, 256), 6, 2)


def linear(w, x, name, outputs):
    return F.linear(x, w(f"{name}.weight", outputs, x.shape[-1]), w(f"{name}.bias", outputs))


def lstm(w, name, inputs, hidden, layers):
    module = torch.nn.LSTM(inputs, hidden, num_layers=layers, batch_first=True)
    with torch.no_grad():
        for key, parameter in module.named_parameters():
            parameter.copy_(w(f"{name}.{key}", *parameter.shape))
    return module


def pooled(w, config, name, x):
    """Res5 of RCNN1 or RCNN2, and what the LSTM reads of its map."""
    y = stage(w, x, f"{name}.res5", channels(config, config["res5_channels"] // 4), 3, 2)
    pool = config["spatial_pool"]
    if pool == "average":
        return F.adaptive_avg_pool2d(y, 1).flatten(1)
    outputs = pool["flatten"]["channels"]
    return F.elu(conv_bn(w, y, f"{name}.reduce.conv", f"{name}.reduce.bn", outputs, 1, 1)).flatten(1)


class Branch:
    """RCNN1 or RCNN2 as a stream."""

    def __init__(self, w, config, name, fc):
        self.w, self.config, self.name, self.fc = w, config, name, fc
        self.lstm = None
        self.reset()

    def reset(self):
        self.state, self.pooled = None, []

    def step(self, x):
        w, config = self.w, self.config
        y = pooled(w, config, self.name, x)
        if self.lstm is None:
            self.lstm = lstm(w, f"{self.name}.lstm", y.shape[1], config["lstm_hidden"], config["lstm_layers"])
        if config["recurrence"] == "carry":
            y, self.state = self.lstm(y[:, None], self.state)
        else:
            self.pooled = (self.pooled + [y])[-config["k"] :]
            y, _ = self.lstm(torch.stack(self.pooled, 1))
        return linear(w, y[:, -1], f"{self.name}.{self.fc}", config[self.fc])


def heads(w, config, x, name):
    out = {
        "translation": linear(w, x, f"{name}.fc4", 3),
        "rotation": linear(w, x, f"{name}.fc5", {"quaternion": 4, "rotation_6d": 6}[config["rotation"]]),
    }
    if config["log_variance"]:
        out["log_variance"] = linear(w, x.detach(), f"{name}.log_variance", 6)
    return out


# --- the cases ------------------------------------------------------------------------------------------------------


def summary(out, name, tensor, samples=SAMPLES):
    """Every n-th value of a large tensor, and its Euclidean norm."""
    flat = tensor.detach().flatten()
    out[f"{name}.sample"] = flat[:: max(1, flat.numel() // samples)].float().clone()
    out[f"{name}.norm"] = flat.double().norm().reshape(1)


def save(name, out, config=None):
    metadata = {"config": json.dumps(config)} if config else None
    save_file({k: v.contiguous() for k, v in out.items()}, HERE / f"{name}.safetensors", metadata=metadata)
    print(name, (HERE / f"{name}.safetensors").stat().st_size, "bytes")


def stream(name, config, frames, reset_before=()):
    """Streams frames and stores poses, LSTM states and features after each."""
    w, out, previous = Weights(), {}, None
    rcnn1, rcnn2 = Branch(w, config, "rcnn1", "fc1"), Branch(w, config, "rcnn2", "fc2")
    for t in range(frames):
        if t in reset_before:
            previous = None
            rcnn1.reset()
            rcnn2.reset()
        features = cnn1(w, config, frame(t, config["input_height_px"], config["input_width_px"]))
        fc1 = rcnn1.step(torch.cat([features if previous is None else previous, features], 1))
        fc2 = rcnn2.step(features)
        previous = features
        fc3 = linear(w, torch.cat([fc1, fc2], 1), "fcfl.fc3", config["fc3"])
        for head, part, x in (("relative", "rcnn1", fc1), ("global", "rcnn2", fc2), ("fused", "fcfl", fc3)):
            for key, value in heads(w, config, x, part).items():
                out[f"{t}.{head}.{key}"] = value
        summary(out, f"{t}.features", features)
        for head, branch in (("relative", rcnn1), ("global", rcnn2)):
            if branch.state is not None:
                summary(out, f"{t}.{head}.h", branch.state[0])
                summary(out, f"{t}.{head}.c", branch.state[1])
    save(name, out, config)


def blocks():
    w, out = Weights(), {}
    x = torch.from_numpy(uniform("block.input", 2 * 8 * 9 * 6, -1.0, 1.0).reshape(2, 8, 9, 6))
    out["conv_bn_elu"] = F.elu(conv_bn(w, x, "conv3x3.conv", "conv3x3.bn", 16, 3, 2))
    out["bottleneck_stride_2"] = bottleneck(w, x, "stride2", 8, 2)
    wide = torch.from_numpy(uniform("block.wide", 2 * 32 * 5 * 4, -1.0, 1.0).reshape(2, 32, 5, 4))
    out["bottleneck_identity"] = bottleneck(w, wide, "identity", 8, 1)
    pooled = torch.from_numpy(uniform("block.pool", 2 * 3 * 7 * 10, -2.0, 0.5).reshape(2, 3, 7, 10))
    out["max_pool"] = F.max_pool2d(F.elu(pooled), 3, 2, 1)
    sequence = torch.from_numpy(uniform("block.sequence", 2 * 5 * 12, -1.0, 1.0).reshape(2, 5, 12))
    out["lstm"], (h, c) = lstm(w, "block.lstm", 12, 7, 2)(sequence)
    out["lstm.h"], out["lstm.c"] = h, c
    save("blocks", out)


GRNET = {
    "width": 1.0,
    "input_height_px": 224,
    "input_width_px": 224,
    "k": 5,
    "branches": {"relative": True, "global": True, "fusion": True},
    "rotation": "quaternion",
    "res5_channels": 2048,
    "spatial_pool": "average",
    "lstm_hidden": 1000,
    "lstm_layers": 2,
    "fc1": 1024,
    "fc2": 1024,
    "fc3": 1024,
    "log_variance": True,
    "recurrence": "carry",
}
SMALL = GRNET | {
    "width": 0.25,
    "input_height_px": 112,
    "input_width_px": 112,
    "rotation": "rotation_6d",
    "spatial_pool": {"flatten": {"channels": 32}},
    "lstm_hidden": 128,
    "fc1": 128,
    "fc2": 128,
    "fc3": 128,
    "recurrence": "rerun_last_k",
}
TINY = GRNET | {"width": 0.125, "lstm_hidden": 20, "fc1": 24, "fc2": 28, "fc3": 32}
ODD = TINY | {
    "input_height_px": 75,
    "input_width_px": 101,
    "res5_channels": 1024,
    "spatial_pool": {"flatten": {"channels": 5}},
    "log_variance": False,
}
RERUN = TINY | {"input_height_px": 48, "input_width_px": 64, "k": 3, "recurrence": "rerun_last_k"}

if __name__ == "__main__":
    with torch.no_grad():
        blocks()
        stream("odd", ODD, 3)
        stream("rerun", RERUN, 6)
        stream("grnet-small", SMALL, 5, reset_before=(3,))
        stream("grnet", GRNET, 4)
