"""Writes `ops.safetensors` and `training-*.safetensors`: `python generate_ops.py` (PyTorch, NumPy, safetensors).

Gradients by PyTorch in double precision, of the operators one by one and of a small network. Inputs and upstream
gradients come from the formula of `generate.py`, so that only results are stored.
"""

import torch
import torch.nn.functional as F
from torch.func import functional_call

from generate import TINY, Weights, cnn1, frame, heads, linear, pooled, save, summary, uniform

FEW = 64  # samples of a tensor of one operator


def made(name, *shape, low=-1.0, high=1.0):
    values = uniform(name, torch.Size(shape).numel(), low, high).reshape(shape)
    return torch.from_numpy(values).double().requires_grad_()


def backward(y, name):
    (y * made(f"{name}.upstream", *y.shape).detach()).sum().backward()


def convolutions(out):
    for kernel in (1, 3, 7):
        for stride in (1, 2):
            for height, width in ((15, 20), (7, 7), (5, 4)):
                name = f"conv.{kernel}.{stride}.{height}x{width}"
                x, weight = made(f"{name}.x", 3, 4, height, width), made(f"{name}.weight", 6, 4, kernel, kernel)
                y = F.conv2d(x, weight, stride=stride, padding=kernel // 2)
                backward(y, name)
                for key, tensor in (("y", y), ("dx", x.grad), ("dweight", weight.grad)):
                    summary(out, f"{name}.{key}", tensor, FEW)


def batch_norms(out):
    for mode in ("batch", "running"):
        for residual in (False, True):
            for activation in ("none", "elu"):
                name = f"bn.{mode}.{'residual' if residual else 'plain'}.{activation}"
                x, weight, bias = made(f"{name}.x", 3, 5, 7, 6, high=3.0), made(f"{name}.weight", 5), made(f"{name}.bias", 5)
                mean, var = made(f"{name}.mean", 5).detach(), made(f"{name}.var", 5, low=0.3).detach()
                y = F.batch_norm(x, mean, var, weight, bias, training=mode == "batch", momentum=1.0, eps=1e-5)
                if residual:
                    added = made(f"{name}.residual", 3, 5, 7, 6)
                    y = y + added
                y = F.elu(y) if activation == "elu" else y
                backward(y, name)
                tensors = {"y": y, "dx": x.grad, "dweight": weight.grad, "dbias": bias.grad}
                tensors |= {"dresidual": added.grad} if residual else {}
                tensors |= {"mean": mean, "var": var} if mode == "batch" else {}
                for key, tensor in tensors.items():
                    summary(out, f"{name}.{key}", tensor, FEW)


def max_pools(out):
    for height, width in ((7, 10), (8, 8), (1, 2), (9, 3)):
        name = f"pool.{height}x{width}"
        x = made(f"{name}.x", 2, 3, height, width, low=-2.0, high=-0.5)
        y = F.max_pool2d(x, 3, 2, 1)
        backward(y, name)
        summary(out, f"{name}.y", y, FEW)
        summary(out, f"{name}.dx", x.grad, FEW)


def adam(out):
    """Six steps with falling learning rate; from the third on gradients are large and clipped to norm 1."""
    shapes, multipliers = {"a": (7,), "b": (4, 3), "c": (2,)}, {"a": 1.0, "b": 0.5, "c": 2.0}
    params = {name: made(f"adam.{name}", *shape) for name, shape in shapes.items()}
    optimizer = torch.optim.Adam([{"params": [p], "name": name} for name, p in params.items()], lr=0.0)
    norms = []
    for step in range(6):
        lr = 0.1 / (1 + step)
        for group in optimizer.param_groups:
            group["lr"] = lr * multipliers[group["name"]]
        size = 0.1 if step < 2 else 10.0
        for name, p in params.items():
            # Parameter c has no gradient in the first step.
            skipped = name == "c" and step == 0
            p.grad = None if skipped else made(f"adam.{name}.{step}", *p.shape, low=-size, high=size).detach()
        norms.append(torch.nn.utils.clip_grad_norm_(params.values(), 1.0))
        optimizer.step()
        for name, p in params.items():
            out[f"adam.{step}.{name}"] = p.detach().float().clone()
    out["adam.norms"] = torch.stack(norms)


def window(w, config, images):
    """The whole network over windows (B, T, 3, H, W)."""
    batch, frames = images.shape[:2]
    features = cnn1(w, config, images.flatten(0, 1))
    by_window = features.unflatten(0, (batch, frames))
    previous = torch.cat([by_window[:, :1], by_window[:, :-1]], 1).flatten(0, 1)

    def branch(name, fc, x):
        y = pooled(w, config, name, x).unflatten(0, (batch, frames))
        hidden, layers = config["lstm_hidden"], config["lstm_layers"]
        lstm = torch.nn.LSTM(y.shape[-1], hidden, num_layers=layers, batch_first=True)
        weights = {key: w(f"{name}.lstm.{key}", *p.shape) for key, p in lstm.named_parameters()}
        y, _ = functional_call(lstm, weights, (y,))
        return linear(w, y.flatten(0, 1), f"{name}.{fc}", config[fc])

    fc1 = branch("rcnn1", "fc1", torch.cat([previous, features], 1))
    fc2 = branch("rcnn2", "fc2", features)
    fc3 = linear(w, torch.cat([fc1, fc2], 1), "fcfl.fc3", config["fc3"])
    parts = (("relative", "rcnn1", fc1), ("global", "rcnn2", fc2), ("fused", "fcfl", fc3))
    return {
        f"{head}.{key}": value.unflatten(0, (batch, frames))
        for head, part, x in parts
        for key, value in heads(w, config, x, part).items()
    }


GRADIENTS = (
    "cnn1.conv1.weight",
    "cnn1.bn1.weight",
    "cnn1.layer1.0.downsample.0.weight",
    "cnn1.layer2.0.conv2.weight",
    "cnn1.layer3.5.bn3.bias",
    "rcnn1.res5.0.conv1.weight",
    "rcnn1.lstm.weight_ih_l0",
    "rcnn1.lstm.weight_hh_l1",
    "rcnn1.lstm.bias_ih_l0",
    "rcnn2.res5.2.conv3.weight",
    "rcnn2.fc2.weight",
    "fcfl.fc3.bias",
)
STATISTICS = ("cnn1.bn1", "cnn1.layer2.0.downsample.1", "rcnn1.res5.2.bn3", "rcnn2.res5.0.bn2")


def network(name, config, trained):
    w, out = Weights(trained), {}
    frames = [frame(t, config["input_height_px"], config["input_width_px"]) for t in range(6)]
    images = torch.cat(frames).double().unflatten(0, (2, 3))  # 6 x (1, 3, H, W) -> (2, 3, 3, H, W)
    outputs = window(w, config, images)
    loss = sum((y * made(f"{key}.upstream", *y.shape).detach()).sum() for key, y in outputs.items())
    loss.backward()
    for key, y in outputs.items():
        out[key] = y.detach().float()
    for key in GRADIENTS:
        if w.made[key].grad is not None:
            summary(out, f"{key}.gradient", w.made[key].grad)
    for key in STATISTICS:
        if key in w.statistics:
            summary(out, f"{key}.mean", w.statistics[key][0])
            summary(out, f"{key}.var", w.statistics[key][1])
    save(name, out, config)


AVERAGE = TINY | {"input_height_px": 48, "input_width_px": 64, "k": 3}
FLATTEN = AVERAGE | {"spatial_pool": {"flatten": {"channels": 5}}, "rotation": "rotation_6d", "log_variance": False}

if __name__ == "__main__":
    torch.set_default_dtype(torch.float64)
    operators = {}
    for case in (convolutions, batch_norms, max_pools, adam):
        case(operators)
    save("ops", operators)
    network("training-all", AVERAGE, lambda name: True)
    network("training-frozen-cnn1", FLATTEN, lambda name: not name.startswith("cnn1."))
