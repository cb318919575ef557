"""How fast this machine is, from a sample of each kind of work that the workflow does."""

import os
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from fourd.cli import set_num_threads
from fourd.matchers.pyramid import PyramidMatcher
from fourd.plan.cost import COMPILED, NETWORK, VISION

# Processor seconds of the samples on the machine on which the rates were measured; the network's within
# the same minutes as the training that its rate is from, for both are slower beside other work.
REFERENCE_S = {COMPILED: 0.085, VISION: 0.088, NETWORK: 0.106}
REPEATS = 3
SIZE = (480, 270)
SEARCH_PX = (0.0, 300.0)
CROP_PX, NUM_FILTERS = 192, 8


def probe_machine() -> dict[str, Any]:
    """The document of `machine/speed.json`: cores, slowness by kind of work, the GPU if there is one.

    Every sample runs on one thread and counts processor time, the least of some repeats, so that what else
    runs on the machine matters little.
    """
    set_num_threads(1)
    left, right = _draw_pair()
    matcher = PyramidMatcher()
    features = cv2.SIFT.create(2000)  # type: ignore[attr-defined]
    step, gpu_step, gpu_name = _network_steps()
    seconds = {
        COMPILED: _least_cpu_s(lambda: matcher.match(left, right, SEARCH_PX)),
        VISION: _least_cpu_s(lambda: features.detectAndCompute(left, None)),
        NETWORK: _least_cpu_s(step),
    }
    gpu_s = None if gpu_step is None else _least_s(gpu_step)
    return {
        "num_cores": len(os.sched_getaffinity(0)),
        "seconds": seconds,
        "slowness": {kind: seconds[kind] / REFERENCE_S[kind] for kind in seconds},
        "gpu_name": gpu_name,
        "gpu_slowness": None if gpu_s is None else gpu_s / REFERENCE_S[NETWORK],
    }


def _draw_pair() -> tuple[np.ndarray, np.ndarray]:
    """Two (H, W, 3) uint8 pictures of one texture, 40 px apart."""
    rng = np.random.default_rng(0)
    width, height = SIZE
    noise = rng.integers(0, 256, (height, width + 40, 3), dtype=np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    return np.ascontiguousarray(texture[:, 40:]), np.ascontiguousarray(texture[:, :-40])


def _network_steps() -> tuple[Callable[[], None], Callable[[], None] | None, str | None]:
    """A training step on the processor, one on the GPU, and the GPU's name; None without one."""
    # Torch takes seconds to import.
    import torch

    from fourd.composition.model import NUM_STREAMS, STREAM_CHANNELS, CompositionNet, resolve_precision

    torch.set_num_threads(1)

    def make_step(device: str) -> Callable[[], None]:
        network = CompositionNet(NUM_FILTERS, 1, 4, "blend", 0).to(device)
        streams = torch.rand(1, NUM_STREAMS, STREAM_CHANNELS, CROP_PX, CROP_PX, device=device)
        precision = resolve_precision("auto", device)

        def step() -> None:
            network(streams, precision).mean().backward()
            if device == "cuda":
                torch.cuda.synchronize()

        return step

    if not torch.cuda.is_available():
        return make_step("cpu"), None, None
    return make_step("cpu"), make_step("cuda"), torch.cuda.get_device_name(0)


def _least_cpu_s(work: Callable[[], object]) -> float:
    return _least(work, time.process_time)


def _least_s(work: Callable[[], object]) -> float:
    return _least(work, time.perf_counter)


def _least(work: Callable[[], object], clock: Callable[[], float]) -> float:
    """Seconds of the fastest of some runs, after one that loads and compiles."""
    work()
    times = []
    for _ in range(REPEATS):
        start = clock()
        work()
        times.append(clock() - start)
    return min(times)
