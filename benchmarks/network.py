"""Bare matrix products, torch on the whole array, and magtwin's blocks: one network, one process.

    python benchmarks/network.py [--net FILE] [--rows N] [--repeats N]

Medians over rounds in which each takes its turn, so that a busy machine slows all three alike. The
bare products are those of the network, float32, 1,024 rows at a time into memory that is there
already, without bias, ReLU or scalers, each shared by torch's threads. magtwin gives each thread
products of its own, which keeps the cores busier, so it may come out a little below 1.
"""

import argparse
import statistics
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from magtwin.learn.magnetometer import NeuralMagnetometer
from magtwin.learn.model import FieldNet, load_net


def bare_products(net, rows, block=1024):
    """A function that does the network's matrix products and nothing else."""
    weights = [layer.weight.detach().t() for layer in net.linears]
    widths = [len(net.features), *net.hidden, 1]
    blocks = [torch.rand(block, width) for width in widths]

    def run():
        for _ in range(0, rows, block):
            for weight, (a, b) in zip(weights, pairwise(blocks), strict=True):
                torch.mm(a, weight, out=b)

    return run


def inputs(net, rows):
    """Features distributed as the training rows were."""
    normal = np.random.default_rng(0).normal(size=(rows, len(net.features)))
    return net.x_mean.numpy() + net.x_scale.numpy() * normal


def measure(net, rows, repeats):
    """Seconds of each way, one list a way."""
    x = inputs(net, rows)
    magnetometer, tensor = NeuralMagnetometer(net), torch.from_numpy(x)
    ways = {
        "bare products": bare_products(net, rows),
        "torch, whole array": lambda: net(tensor),
        "magtwin": lambda: magnetometer.predict(x),
    }
    seconds = {name: [] for name in ways}
    with torch.inference_mode():
        for turn in range(repeats + 1):
            for name, way in ways.items():
                start = time.perf_counter()
                way()
                if turn:  # the first is warm-up
                    seconds[name].append(time.perf_counter() - start)
        worst = float((net.double()(tensor) - torch.from_numpy(magnetometer.predict(x))).abs().max())
    return seconds, worst


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--net", type=Path, help="weights; without, the paper's shape with random weights")
    parser.add_argument("--rows", type=int, default=81_000, help="readings; 81,000 are 10 min at 135 Hz")
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    net = (load_net(options.net) if options.net else FieldNet()).eval()
    seconds, worst = measure(net, options.rows, options.repeats)
    layers = "-".join(str(n) for n in (len(net.features), *net.hidden, 1))
    print(f"{options.rows:,} readings through {layers}, {torch.get_num_threads()} threads, "
          f"median of {options.repeats} (least)")  # fmt: skip
    bare = statistics.median(seconds["bare products"])
    for name, times in seconds.items():
        median = statistics.median(times)
        print(f"  {name:20} {median:6.3f} s ({min(times):.3f})  {options.rows / median:9,.0f} readings/s"
              f"  {median / bare:5.2f} x bare")  # fmt: skip
    print(f"  largest error of magtwin against float64: {worst:.4f} nT")


if __name__ == "__main__":
    main()
