"""What a held-out camera filmed reaches nothing that makes its render.

No job on the way to a render is handed the camera's pictures, but for those that put it on the
clock and into the world, and the one that compares colours; that this one gives the same bits for
every input whatever a held-out camera shows is tested with the stage frames.
"""

import re

import pytest

from tests.conftest import Workspace, tiny_scene

HELDOUT = "cam02"
# These bring films onto the clock, place cameras, or compare colours.
PLACING = {"demo_frames", "demo_cameras", "probe_camera", "sample_camera"}
PLACING |= {"import_cameras", "place_view", "match_colours"}
# What is made for the place where the camera stands, not from its pictures.
MADE_FOR_ITS_PLACE = ("views", "foreground", "background", "render")


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str]]:
    """(rule, command) of every job that a render of the held-out camera needs, in a dry run."""
    workspace = Workspace(tmp_path_factory.mktemp("protocol"))
    workspace.write_scene("demo", tiny_scene())
    target = f"results/demo/render/{HELDOUT}/000000-000002"
    output = workspace.snakemake("-n", "--printshellcmds", target).stdout
    jobs = re.split(r"^(?:local)?rule (\w+):$", output.split("Job stats:")[1], flags=re.MULTILINE)[1:]
    found = []
    for rule, text in zip(jobs[::2], jobs[1::2], strict=True):
        command = re.search(r"python -m fourd\.\S+ .*", text)
        found += [(rule, command.group().split(" 2> ")[0])] if command else []
    assert found, output[-3000:]
    return found


def test_no_job_that_makes_a_render_is_handed_the_cameras_pictures(commands):
    rules = {rule for rule, _ in commands}
    assert rules >= {"fuse_foreground", "estimate_background", "train_level", "render_frames", "disparity"}
    for rule, command in commands:
        if rule in PLACING:
            continue
        paths = [word for word in command.split() if HELDOUT in word]
        assert all(any(f"/{kind}/{HELDOUT}" in path for kind in MADE_FOR_ITS_PLACE) for path in paths), (
            rule,
            paths,
        )


def test_the_cameras_film_is_not_even_prepared(commands):
    prepared = [command for rule, command in commands if rule == "prepare_camera"]
    assert len(prepared) == 4 and not any(HELDOUT in command for command in prepared)


def test_training_and_disparity_know_nothing_of_the_camera(commands):
    for rule, command in commands:
        if rule in ("train_level", "fuse_training", "disparity", "rectify_pair", "silhouettes"):
            assert HELDOUT not in command, rule
