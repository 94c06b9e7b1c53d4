"""Runs a robot on one host and its model on another, here both on this computer.

    python examples/two_hosts.py

In a lab, run `vla-zenoh up panda_sim_two_hosts --host robot` and `... --host gpu` on a computer
each, after `vla-zenoh secure init` made certificates for them (docs/how-to/security.md).
"""

import signal
import subprocess
import sys
import time

import vla_zenoh

HOSTS, READY_S = ("robot", "gpu"), 60.0


def main(profile: str = "panda_sim_two_hosts") -> None:
    """Start both hosts, move the arm, stop both."""
    up = [sys.executable, "-m", "vla_zenoh", "up", profile, "--host"]
    hosts = [subprocess.Popen([*up, host]) for host in HOSTS]
    try:
        give_up_s = time.monotonic() + READY_S
        while True:
            try:
                with vla_zenoh.connect(profile) as robot:
                    robot.set_prompt("HARD: go up x10")
                    robot.activate_with_deadman("two-hosts")
                    time.sleep(3)
                    print("z =", robot.pose_state().record.position_m[2])
                    robot.deactivate()
                break
            except vla_zenoh.VlaZenohError as error:  # not ready yet: it says what is missing
                if time.monotonic() > give_up_s:
                    raise
                print(error)
                time.sleep(1)
    finally:
        for host in hosts:
            host.send_signal(signal.SIGINT)  # brakes the arm, then stops the nodes
        for host in hosts:
            host.wait(20)


if __name__ == "__main__":
    main(*sys.argv[1:])
