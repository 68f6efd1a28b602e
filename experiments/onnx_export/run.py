"""A trained touch encoder as ONNX, checked against the live model.

    make export-onnx RUN=runs/stage2 OUT=encoder.onnx FRAMES=3

This process runs the live model; another, with jax2onnx and onnxruntime in a separate environment (jax2onnx wants an
older Orbax), converts it and runs the result on the same touches. Nothing is written when they differ.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from anytouch_jax.cli.output import check_folder
from anytouch_jax.config import to_json
from anytouch_jax.encoder.encoder import check_frames, load_encoder
from anytouch_jax.encoder.export import call_of, describes
from anytouch_jax.errors import UserError
from anytouch_jax.weights.safetensors import export_safetensors

BATCHES = (1, 5)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="run folder or weights file")
    parser.add_argument("--out", type=Path, required=True, help="the .onnx to write")
    parser.add_argument("--frames", type=int, default=1, help="frames of a touch: 1 (stills) or 3")
    parser.add_argument("--python", type=Path, required=True, help="python of the environment with jax2onnx")
    options = parser.parse_args()
    check_folder(options.out, read=(options.run,))
    encoder = load_encoder(options.run).computed_in("float32")
    model = encoder.config.model
    check_frames(model, options.frames)
    rng, size = np.random.default_rng(0), model.image_size
    with TemporaryDirectory(dir=options.out.parent, prefix=f".{options.out.name}.") as name:
        folder = Path(name)
        export_safetensors(folder / "params.safetensors", encoder.params, {"model": to_json(model)})
        cases = {}
        for count in BATCHES:
            touches = rng.integers(0, 256, (count, options.frames, size, size, 3), np.uint8)
            sensor = rng.integers(0, len(model.sensors), count).astype(np.int32)
            cases |= {f"touches{count}": touches, f"sensor{count}": sensor}
            cases[f"features{count}"] = encoder.encode_touch(touches, sensor)
        np.savez(folder / "cases.npz", **cases)
        worker = Path(__file__).with_name("worker.py")
        source = Path(__file__).resolve().parents[2] / "src"
        command = [str(options.python), str(worker), str(folder)]
        done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(source)}, check=False)
        if done.returncode:
            print("the conversion failed: nothing is written", file=sys.stderr)
            return 1
        about = call_of(encoder, frames=options.frames, width=cases[f"features{BATCHES[0]}"].shape[1])
        about["input"] = about["input"].replace("frames:", "touches:", 1)
        (folder / "about.json").write_text(json.dumps(about, indent=2) + "\n")
        os.replace(folder / "model.onnx", options.out)
        os.replace(folder / "about.json", describes(options.out))
    print(f"{describes(options.out)}: how to call it")
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"onnx_export: {error}")
