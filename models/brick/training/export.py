# /// script
# requires-python = ">=3.11"
# dependencies = [
#   "vla-zenoh", "torch>=2.4", "safetensors>=0.4", "onnx", "onnxscript", "onnxruntime>=1.20",
# ]
# ///
"""Exports trained weights for the worker, and checks that both give the same outputs.

    python export.py RUN [--out FOLDER]

Writes ``brick.onnx``, ``training/brick.safetensors`` and ``weights.json`` with the sha256 of both
and the words the policy knows.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from encoder import pieces
from net import HAND, HORIZON, Policy
from safetensors.torch import load_file
from worker import FOLDER, FRONT, GRAPH, MANIFEST, MAX_PIECES, WORDS, WRIST

INPUTS = ("tokens", "front", "wrist", "hand", "given")
OUTPUTS = ("offset", "opened", "understood", "order", "bricks", "box")
TOLERANCE, LOOSE = 1e-4, 1e-3
"""Between PyTorch and onnxruntime, in the outputs' own units (m, rad, probability). The loose one
is for outputs that are ambiguous for noise: turns of bricks, and whether random pieces are a
task."""
TRIALS = 20


def inputs(random: np.random.Generator, words: int) -> dict[str, np.ndarray]:
    """Random input of the right shapes."""
    tokens = random.integers(1, words, (1, MAX_PIECES))
    tokens[0, random.integers(1, MAX_PIECES) :] = 0
    found = {
        "tokens": tokens.astype(np.int64),
        "front": random.integers(0, 256, (1, FRONT[1], FRONT[0], 3), dtype=np.uint8),
        "wrist": random.integers(0, 256, (1, WRIST[1], WRIST[0], 3), dtype=np.uint8),
        "hand": random.normal(size=(1, HAND)).astype(np.float32),
    }
    given = 0.1 * random.normal(size=(1, HORIZON, 6)).astype(np.float32)
    given[..., 5] = np.arange(HORIZON) < random.integers(HORIZON)
    given[..., :5] *= given[..., 5:]
    return found | {"given": given}


def strip(graph: Path) -> None:
    """Remove the origin of each node: the exporter writes paths of this computer into it."""
    model = onnx.load(str(graph))
    for part in (
        *model.graph.node,
        *model.graph.value_info,
        *model.graph.input,
        *model.graph.output,
    ):
        del part.metadata_props[:]
        part.doc_string = ""
    del model.graph.metadata_props[:]
    onnx.save(model, str(graph))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder with policy.safetensors")
    parser.add_argument("--out", type=Path, default=FOLDER)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    words = pieces()
    net = Policy(len(words) + 2)
    net.load_state_dict(load_file(args.run / "policy.safetensors"))
    net.eval()
    random = np.random.default_rng(0)
    example = {name: torch.from_numpy(v) for name, v in inputs(random, len(words) + 2).items()}
    graph = args.out / GRAPH
    torch.onnx.export(
        net,
        tuple(example.values()),
        str(graph),
        input_names=list(INPUTS),
        output_names=list(OUTPUTS),
        opset_version=18,
        external_data=False,
        dynamo=True,
    )
    strip(graph)
    session = onnxruntime.InferenceSession(str(graph), providers=["CPUExecutionProvider"])
    worst = dict.fromkeys(OUTPUTS, 0.0)
    for _ in range(TRIALS):
        feed = inputs(random, len(words) + 2)
        with torch.no_grad():
            wanted = net(*(torch.from_numpy(value) for value in feed.values()))
        got = session.run(list(OUTPUTS), feed)
        for name, one, other in zip(OUTPUTS, wanted, got, strict=True):
            worst[name] = max(worst[name], float(np.abs(one.numpy() - other).max(initial=0)))
    for name, off in worst.items():
        allowed = LOOSE if name in ("understood", "bricks") else TOLERANCE
        if off > allowed:
            raise SystemExit(f"{name} differs from PyTorch by {off:.2g}, allowed: {allowed:g}")
    weights = args.out / "training" / "brick.safetensors"
    weights.parent.mkdir(exist_ok=True)
    shutil.copyfile(args.run / "policy.safetensors", weights)
    (args.out / WORDS).write_text("\n".join(words) + "\n", "utf-8")
    sha256 = {
        str(p.relative_to(args.out)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in (graph, weights, args.out / WORDS)
    }
    manifest = {"sha256": sha256}
    (args.out / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", "utf-8")
    size = sum(p.stat().st_size for p in (graph, weights))
    print(f"parity within {max(worst.values()):.2g}; {size / 1e6:.2f} MB in {args.out}")


if __name__ == "__main__":
    main()
