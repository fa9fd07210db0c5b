"""Training and streaming steps of the same network in PyTorch on a GPU, with the output of `gpu_step.rs`:
`gpu_peer.py PRESET [WINDOWS...]`."""

import pathlib
import sys
import time

import torch

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
from training_peer import K, PRESETS, Network  # noqa: E402

ROUNDS, WARM_UP = 7, 2


def median_ms(work):
    rounds = []
    for _ in range(WARM_UP + ROUNDS):
        torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        torch.cuda.synchronize()
        rounds.append((time.perf_counter() - start) * 1e3)
    return sorted(rounds[WARM_UP:])[ROUNDS // 2]


def report(what, preset, windows, precision, ms, frames):
    free, total = torch.cuda.mem_get_info()
    print(f"{what} {preset} {windows} {precision} {ms:.2f} {frames / ms * 1e3:.0f} {(total - free) >> 20}", flush=True)


def main():
    preset, *windows = sys.argv[1:]
    c = PRESETS[preset]
    for precision in ("f32", "tf32"):
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "tf32"
        torch.manual_seed(7)
        network = Network(c).cuda()
        side = c["side"]
        with torch.no_grad():
            image = torch.rand(1, 1, 3, side, side) * 2 - 1
            network.eval()
            # One frame as a window of one: the LSTMs' state is zero, which changes no time.
            ms = median_ms(lambda: [y.cpu() for y in network(image.cuda())])
            report("stream", preset, 1, precision, ms, 1)
        network.train()
        optimizer = torch.optim.Adam(network.parameters(), lr=1e-5, fused=True)
        for count in map(int, windows or ("1", "4", "8", "16")):
            images = torch.rand(count, K, 3, side, side) * 2 - 1

            def step():
                optimizer.zero_grad(set_to_none=True)
                sum(y.square().mean() for y in network(images.cuda())).backward()
                norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
                assert torch.isfinite(norm)
                optimizer.step()

            report("train", preset, count, precision, median_ms(step), count * K)


main()
