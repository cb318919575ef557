"""The bench that compares the network's settings, on a scene of a few pixels."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from benches.composition import (
    VARIANTS,
    Event,
    HeldOutFrame,
    average_views,
    compose_images,
    draw_sheet,
    measure_variants,
    train_variant,
)
from fourd import io, metrics
from fourd.composition import CompositionOptions, data

ROOT = Path(__file__).resolve().parents[2]
SMALL = CompositionOptions(num_filters=(2, 2), depth=1, crop=16)


@pytest.fixture(scope="module")
def event(tmp_path_factory):
    """One sample to train on, whose consensus is 10 grey levels too bright; it is also held out."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("event")
    truth = np.random.default_rng(0).integers(0, 200, (16, 24, 3), np.uint8)
    for kind in ("foreground", "background"):
        keys = [key for archive, key in data.ESTIMATES if archive == kind]
        arrays = {f"{key}_rgb": truth + np.uint8(10) for key in keys}
        arrays |= {f"{key}_valid": np.ones((16, 24), bool) for key in keys}
        with io.ArchiveWriter(folder / f"{kind}.npz", {"view": "cam00"}) as writer:
            writer.add_frame(0, **arrays)
    samples, coarse = (
        data.SampleSet(
            [folder / "foreground.npz"],
            [folder / "background.npz"],
            lambda cam, frame: (truth, np.ones((16, 24), bool)),
            factor,
            8,
        )
        for factor in (1, 2)
    )
    images, dynamic = samples.images(samples.ids[0]), np.zeros((16, 24), bool)
    return Event(samples, coarse, {"held": [HeldOutFrame(images, np.ones((16, 24), bool), dynamic)]})


def test_every_variant_is_of_options_that_exist():
    for variant in VARIANTS.values():
        dataclasses.replace(SMALL, **variant.changes)


def test_rule_asks_for_variants_that_exist():
    text = (ROOT / "rules/ablations.smk").read_text(encoding="utf-8")
    names = re.findall(r'"(.*?)"', text.split("ABLATIONS = [")[1].split("]")[0])
    assert len(names) > 5 and set(names) <= VARIANTS.keys()


def test_rows_say_what_a_variant_reaches_at_a_mark(event):
    rows, pictures = measure_variants(event, ["default", "input_closest"], SMALL, [0.02, 0.05])
    assert [row["variant"] for row in rows] == ["inst", "paste", *["default"] * 2, *["input_closest"] * 2]
    assert rows[1]["mse"] == 100
    assert rows[1]["psnr_db"] == pytest.approx(metrics.psnr_from_mse(100))
    assert np.isnan(rows[1]["dynamic_psnr_db"])
    for early, late in (rows[2:4], rows[4:6]):
        assert 0 < early["steps"] < late["steps"]
        assert early["cpu_seconds"] >= 0.02 and late["cpu_seconds"] >= 0.05
        assert late["mse_share"] == late["mse"] / 100
    assert np.isnan(rows[1]["lpips"])
    assert set(pictures) == {("held", name) for name in ("inst", "paste", "default", "input_closest")}
    assert draw_sheet({name: picture for (_, name), picture in pictures.items()}).shape[1] == 3 * 24 + 4
    means = average_views(rows[2:])
    assert means[0]["rms_error"] == pytest.approx(rows[2]["mse"] ** 0.5)


def test_coarser_level_fills_what_the_finer_one_is_not_given(event):
    """Both levels are trained in turns, and a hole that only the coarser one can fill is filled by it."""
    images = event.samples.images(event.samples.ids[0]).copy()
    options = dataclasses.replace(SMALL, precision="float32")
    ((cost, networks),) = train_variant(event, VARIANTS["cascade"], options, [0.02])
    assert len(networks) == 2 and cost["steps"] > 0
    whole = compose_images(networks, images)
    np.testing.assert_array_equal(whole, compose_images(networks[1:], images))
    images[: data.TARGET, 4:10, 6:14] = 0
    filled, alone = compose_images(networks, images), compose_images(networks[1:], images)
    assert (filled != alone)[4:10, 6:14].any()
