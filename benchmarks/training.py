"""Training the paper's network beside a bare torch loop and bare matrix products, in one process.

    python benchmarks/training.py [--steps N] [--rows N] [--threads N]

magtwin's is `magtwin.learn.training.fit_network.train` as `magtwin train` calls it: 600,000 x 20 float64
rows, 1,024 a step,
dropout .3, Adam. The bare loop is what one writes with torch alone: the same layers in eager mode with ReLU
and Dropout, tensors in memory, shuffled indices, mean squared error, fused Adam. The bare products are those
of the network forward and backward (not for the gradient of the inputs), float32, into memory that is there
already. They take turns every few steps. On one thread processor time is taken, which other work on the
machine disturbs least; on more, time by the clock.
"""

import argparse
import itertools
import statistics
import time

import numpy as np
import torch

from magtwin.learn.data.features import FULL
from magtwin.learn.training.fit_network import train

WANTED, GOAL = 0.95, 0.80
LAYERS = (512, 512, 512, 512)
BATCH, DROPOUT = 1024, 0.3
EACH = 5
"""Steps of a turn."""


class Enough(Exception):  # noqa: N818 - it is no error
    """As many steps as were asked for have been made."""


def bare_loop(x, y):
    """A generator that makes steps of a plain torch loop; each next() makes one."""
    layers = []
    widths = [x.shape[1], *LAYERS]
    for i, (a, b) in enumerate(itertools.pairwise(widths)):
        layers += [torch.nn.Linear(a, b), torch.nn.ReLU()]
        layers += [torch.nn.Dropout(DROPOUT)] if i < len(LAYERS) - 1 else []
    net = torch.nn.Sequential(*layers, torch.nn.Linear(LAYERS[-1], 1))
    adam = torch.optim.Adam(net.parameters(), lr=1e-3, fused=True)
    z = torch.from_numpy((x - x.mean(axis=0)) / x.std(axis=0)).float()
    label = torch.from_numpy((y - y.mean()) / y.std()).float()
    while True:
        for chosen in torch.randperm(len(z)).split(BATCH):
            adam.zero_grad(set_to_none=True)
            loss = torch.nn.functional.mse_loss(net(z[chosen]).squeeze(-1), label[chosen])
            loss.backward()
            adam.step()
            yield


def bare_products(inputs):
    """A function that does the matrix products of one step and nothing else."""
    widths = [inputs, *LAYERS, 1]
    weights = [torch.full((a, b), 1 / a) for a, b in itertools.pairwise(widths)]
    slopes = [torch.empty(b, a) for a, b in itertools.pairwise(widths)]
    blocks, errors = ([torch.ones(BATCH, width) for width in widths] for _ in range(2))

    def step():
        for i, weight in enumerate(weights):
            torch.mm(blocks[i], weight, out=blocks[i + 1])
        for i in range(len(weights) - 1, -1, -1):
            torch.mm(errors[i + 1].t(), blocks[i], out=slopes[i])
            if i:
                torch.mm(errors[i + 1], weights[i].t(), out=errors[i])

    return step


def measure(rows, steps, threads):
    """Seconds a step of each way, one list a way."""
    clock = time.process_time if threads == 1 else time.perf_counter
    rng = np.random.default_rng(0)
    x = rng.standard_normal((rows, len(FULL)))
    y = 300 + 200 * x[:, 0] + 50 * x[:, 1] ** 2 + rng.normal(0, 50, rows)
    seconds = {"bare products": [], "bare torch loop": [], "magtwin": []}
    loop, products = bare_loop(x, y), bare_products(x.shape[1])
    others = {"bare products": products, "bare torch loop": lambda: next(loop)}
    began, made = 0.0, 0

    def advance(done, total):
        nonlocal began, made
        made += 1
        if made % EACH:
            return
        seconds["magtwin"].append((clock() - began) / EACH)
        for name, step in others.items():
            start = clock()
            for _ in range(EACH):
                step()
            seconds[name].append((clock() - start) / EACH)
        if made >= steps:
            raise Enough
        began = clock()

    torch.set_num_threads(threads)
    try:
        began = clock()
        train(x, y, x[:1000], y[:1000], rng=rng, layers=LAYERS, batch=BATCH, dropout=DROPOUT, advance=advance)
    except Enough:
        pass
    return {name: times[1:] for name, times in seconds.items()}  # the first is warm-up, and the rows' scaling


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--rows", type=int, default=600_000)
    parser.add_argument("--threads", type=int, default=0, help="1 and as many as torch has, unless given")
    options = parser.parse_args()
    most = torch.get_num_threads()
    for threads in [options.threads] if options.threads else sorted({1, most}):
        seconds = measure(options.rows, options.steps, threads)
        by = "1 thread, processor time" if threads == 1 else f"{threads} threads, by the clock"
        print(f"{options.rows:,} x {len(FULL)} rows, {options.steps} steps of {BATCH:,}, {by}")
        for name, times in seconds.items():
            median = statistics.median(times)
            print(f"  {name:16} {1e3 * median:7.1f} ms a step  {BATCH / median:9,.0f} samples/s")
        loop, product = (
            statistics.median(a / b for a, b in zip(seconds[name], seconds["magtwin"], strict=True))
            for name in ("bare torch loop", "bare products")
        )
        print(f"  magtwin is at {loop:.2f} of the bare loop's rate; wanted {WANTED:.2f}")
        print(f"  and at {product:.2f} of the bare products' rate; goal {GOAL:.2f}")


if __name__ == "__main__":
    main()
