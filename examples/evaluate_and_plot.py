"""Reads a recording, prints how far the arm went and how long commands took, plots its height.

    vla-zenoh record -o run.mcap                  # while the robot moves; Ctrl-C ends it
    python examples/evaluate_and_plot.py run.mcap

`vla-zenoh eval run.mcap` makes a whole report.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from vla_zenoh.lab.recording.run import load_run


def main(recording: str, plot: str = "height.png") -> None:
    """Print figures of `recording` and write `plot`."""
    run = load_run(Path(recording))
    time_s = np.array([pose.header.stamp_wall_ns for pose in run.poses]) * 1e-9
    position_m = np.array([pose.record.position_m for pose in run.poses])
    path_m = np.linalg.norm(np.diff(position_m, axis=0), axis=1).sum()
    print(f"{len(run.chunks)} chunks; path of the TCP: {path_m:.3f} m")
    latencies_ms = [(at - cause.observation_stamp_ns) / 1e6 for cause, at in run.first_commands()]
    if latencies_ms:
        p50, p95 = np.percentile(latencies_ms, (50, 95))
        print(f"observation to first command: p50 {p50:.1f} ms, p95 {p95:.1f} ms")
    plt.plot(time_s - time_s[0], position_m[:, 2])
    plt.xlabel("time [s]")
    plt.ylabel("height of the TCP [m]")
    plt.savefig(plot)
    print(f"wrote {plot}")


if __name__ == "__main__":
    main(*sys.argv[1:])
