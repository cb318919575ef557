"""The pictures of the README from a finished demo: `python -m benches.readme_picture`."""

import argparse
from pathlib import Path

import cv2
import numpy as np

from fourd.image import label_image, tile_images
from fourd.ingest import open_camera
from fourd.io import read_image

FILMED = ("cam01", "cam03", "cam06", "cam07")
FILM_FRAMES = (0, 10, 19, 29)
LABEL_HEIGHT = 22
WIDTH = 1600


def labelled(image: np.ndarray, text: str) -> np.ndarray:
    return np.concatenate([label_image(text, (image.shape[1], LABEL_HEIGHT)), image])


def filmed(results: Path, cam: str) -> np.ndarray:
    """What a phone filmed at the moment that is frozen."""
    with open_camera(results / "frames" / "cameras" / f"{cam}.npz") as reader:
        return reader.read(15, is_raw=True)


def write_jpg(path: Path, picture: np.ndarray) -> None:
    scale = WIDTH / picture.shape[1]
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    # OpenCV writes nothing, and says nothing, where there is no folder.
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("results/demo"))
    parser.add_argument("--output", type=Path, default=Path("docs"))
    args = parser.parse_args()
    film = {int(p.stem): p for p in (args.results / "render" / "freeze_time").glob("*/*.png")}
    rows = [
        [labelled(filmed(args.results, cam), f"filmed by {cam}") for cam in FILMED],
        [
            labelled(read_image(film[frame]), f"rendered: time frozen, view {frame + 1} of 30")
            for frame in FILM_FRAMES
        ],
    ]
    write_jpg(args.output / "demo.jpg", tile_images(rows))
    write_jpg(args.output / "heldout.jpg", read_image(args.results / "evaluate" / "contact_sheet.png"))


if __name__ == "__main__":
    main()
