"""Films on the common clock for tests of later stages: what ingest and align leave behind."""

from pathlib import Path

from fourd.align.__main__ import main as align_main
from fourd.ingest.__main__ import main as ingest_main


def put_on_clock(source: Path, name: str, output: Path, fps: float, num_frames: int, **flags: float) -> Path:
    """Ingest a source and put it on a given clock: writes the file that `open_camera` reads."""
    facts = output.with_name(f"{name}_facts.json")
    words = ["--camera", name, "--source", str(source), "--fps", str(fps)]
    ingest_main([*words, "--output-json", str(facts), "--output-table", str(facts.with_suffix(".csv"))])
    words = [
        f"--{key.replace('_', '-')}={value}"
        for key, value in {"offset_s": 0.0, "start_s": 0.0, **flags}.items()
    ]
    words += ["--fps", str(fps), "--num-frames", str(num_frames), "--ingest", str(facts)]
    align_main(["sample", *words, "--output", str(output)])
    return output
