"""vla-zenoh camera board, camera calibrate: a board to print, and a camera calibrated with it."""

from __future__ import annotations

import re
import select
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.plain import say, warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.client import Client
from vla_zenoh.client.primitives import ask
from vla_zenoh.errors import nearest
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import RUNS, ForceOption, output_file, output_folder
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.nodes.camera.geometry import Intrinsics, read_intrinsics
from vla_zenoh.profile import CameraProfile, Profile, read_profile
from vla_zenoh_calibrate.arm import Arm
from vla_zenoh_calibrate.board import DICTIONARIES, Board
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.hand_eye import EYES, Eye, calibrate_hand_eye
from vla_zenoh_calibrate.lens import board_pose, calibrate_lens
from vla_zenoh_calibrate.picture import arm_frames, with_frames
from vla_zenoh_calibrate.profile_edit import backup, write_profile
from vla_zenoh_calibrate.result import Calibration, mount_of, write_files
from vla_zenoh_calibrate.sampling import Sampler, Taken
from vla_zenoh_calibrate.streams import Live, read_recording, recordings_of
from vla_zenoh_calibrate.tour import read_joints, tour

SAME_ASPECT = 0.01
DWELL_S, MOVE_S = 1.5, 30.0
MAX_FAILED = 3


@dataclass(frozen=True)
class BoardOptions:
    """The board."""

    squares: Annotated[
        str, typer.Option("--squares", help="Squares of the board, COLUMNSxROWS.")
    ] = "9x6"
    square_m: Annotated[
        float,
        typer.Option(
            "--square-m", help="Side of a square, measured after printing, m.", min=0.001, max=1
        ),
    ] = 0.03
    marker_m: Annotated[
        float, typer.Option("--marker-m", help="Side of a marker, m.", min=0.001, max=1)
    ] = 0.022
    dictionary: Annotated[
        str, typer.Option("--dictionary", help=f"Of the markers: {', '.join(DICTIONARIES)}.")
    ] = "5X5_100"

    def board(self) -> Board:
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", self.squares)
        if match is None:
            raise typer.BadParameter(f"--squares wants COLUMNSxROWS, as 9x6, not {self.squares!r}")
        sides = int(match[1]), int(match[2])
        return Board(*sides, self.square_m, self.marker_m, self.dictionary)


@options
def board(
    given: BoardOptions,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File to write: .pdf or .png.")
    ] = Path("board.pdf"),
    dpi: Annotated[int, typer.Option("--dpi", help="Of a .png.", min=72, max=1200)] = 300,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a ChArUco board to print at true size.

    Stick it on something flat and stiff, glass or aluminium, and measure a square: that is the
    --square-m of `camera calibrate`.
    """
    made = given.board()
    if output.suffix not in (".pdf", ".png"):
        raise typer.BadParameter(f"--output {output}: wants .pdf or .png")
    with output_file(output, force=force) as file:
        file.write_bytes(made.pdf() if output.suffix == ".pdf" else made.png(dpi))
    if as_json:
        size = dict(zip(("width_m", "height_m"), made.size_m, strict=True))
        print_json({"file": str(output), **asdict(made), **size})
        return
    width, height = (side * 1e3 for side in made.size_m)
    say(f"{output}: {made.written}; {width:g} x {height:g} mm without margin")
    say(
        f"print it at 100 %, not fitted to the page; then measure: a square should be "
        f"{made.square_m * 1e3:g} mm; a whole row is measured better than one"
    )


@dataclass(frozen=True)
class Way:
    """Where views come from."""

    recording: Annotated[
        Path | None,
        typer.Option("--recording", "-r", help="A recording or run folder, instead of the bus."),
    ] = None
    views: Annotated[int, typer.Option("--views", help="How many to take.", min=6, max=200)] = 25
    enter: Annotated[
        bool,
        typer.Option("--enter", help="Take a view when Enter is pressed, not by itself."),
    ] = False
    tour: Annotated[
        bool,
        typer.Option(
            "--tour", help="Let the arm go around its present pose; asks before it moves."
        ),
    ] = False
    tour_file: Annotated[
        Path | None,
        typer.Option("--tour-file", help="Let it go to these joints: a YAML list of lists, rad."),
    ] = None
    ahead_m: Annotated[
        float,
        typer.Option("--ahead-m", help="From the TCP to the board, for --tour.", min=0.05, max=2),
    ] = 0.3
    jpeg: Annotated[
        bool, typer.Option("--jpeg", help="Take the JPEG stream: of a camera on another host.")
    ] = False
    pose_state: Annotated[
        bool,
        typer.Option(
            "--pose-state", help="Poses as the robot says, not by its joints and description."
        ),
    ] = False


@dataclass(frozen=True)
class Wanted:
    """What is calibrated, and where it goes."""

    eye: Annotated[
        str | None,
        typer.Option(
            "--eye",
            help="in-hand: the camera is on the arm, the board lies still. to-hand: the camera "
            "stands, the arm holds the board. Default: only the lens.",
        ),
    ] = None
    keep_lens: Annotated[
        bool, typer.Option("--keep-lens", help="Take the lens that the camera's node reports.")
    ] = False
    lens: Annotated[
        Path | None, typer.Option("--lens", help="Take the lens of this file, as in a profile.")
    ] = None
    link: Annotated[
        str | None,
        typer.Option("--link", help="Link for the mount; default: that of the profile."),
    ] = None
    part: Annotated[str, typer.Option("--part", help="Which arm, of a robot of several parts.")] = (
        ""
    )
    write: Annotated[
        Path | None,
        typer.Option("--write", help="Profile (YAML) to write it into; a backup is kept."),
    ] = None
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="New folder; default: runs/calibration-CAMERA-<time>."),
    ] = None


@options
def calibrate(
    camera: Annotated[str, typer.Argument(help="Name of the camera in the profile.")],
    target: RobotTarget,
    wanted: Wanted,
    way: Way,
    given: BoardOptions,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a camera's lens and its place, with a printed ChArUco board.

    Move the arm by hand, or with --tour: a view is taken whenever it stands where it was not yet.
    Ctrl-C ends that and calibrates with the views there are.
    """
    made, eye = given.board(), _eye(wanted, way)
    tell = warn if as_json else say
    name = f"calibration-{camera}-{time.strftime('%Y%m%d-%H%M%S')}"
    with output_folder(wanted.output or RUNS / name, force=force) as folder:
        session = _Session(camera, made, eye, wanted, way, tell)
        if way.recording is not None:
            session.read(way.recording)
        else:
            with target.client() as client:
                session.watch(client)
        found = session.calibrated()
        write_files(folder, found)
        picture = session.picture(found)
        cv2.imwrite(str(folder / "frames.jpg"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if as_json:
        print_json(found.report())
    else:
        _say_result(found, wanted.output or RUNS / name)
    if wanted.write is not None:
        _write(wanted.write, found, tell)


def _eye(wanted: Wanted, way: Way) -> Eye | None:
    for eye in EYES:
        if wanted.eye == eye:
            return eye
    if wanted.eye is not None:
        raise typer.BadParameter(f"--eye {wanted.eye!r}: {' or '.join(EYES)}")
    if wanted.keep_lens or wanted.lens is not None:
        raise typer.BadParameter("a known lens and no --eye: nothing is left to calibrate")
    if way.tour or way.tour_file is not None:
        raise typer.BadParameter("--tour needs --eye: it moves the arm")
    return None


class _Session:
    """The views of one calibration, and what is made of them."""

    def __init__(
        self,
        camera: str,
        board: Board,
        eye: Eye | None,
        wanted: Wanted,
        way: Way,
        tell: Callable[[str], None],
    ) -> None:
        self._name, self._board = camera, board
        self._eye: Eye | None = eye
        self._wanted, self._way, self._tell = wanted, way, tell
        self.sampler = Sampler(board, with_arm=eye is not None)
        self._reported: Mapping[str, float] = {}
        self._camera: CameraProfile | None = None
        self._arm: Arm | None = None
        self._link = self._frame = ""

    def _prepare(self, profile: Profile) -> None:
        """Check everything that can be wrong before a view is taken."""
        if self._name not in profile.cameras:
            raise CalibrationError(
                f"the profile has no camera {self._name!r}{nearest(self._name, profile.cameras)} "
                f"It has: {', '.join(profile.cameras) or 'none'}"
            )
        camera = profile.cameras[self._name]
        if not (self._wanted.keep_lens or self._wanted.lens):
            _require_whole_images(self._name, camera)
        if self._wanted.part not in profile.part_names:
            raise CalibrationError(
                f"the robot has the parts {', '.join(profile.part_names) or 'none'}: name one "
                "with --part"
            )
        self._camera = camera
        if self._eye is None:
            return
        arm = Arm(profile.of_part(self._wanted.part), "pose" if self._way.pose_state else "joint")
        usual = arm.tcp if self._eye == "in-hand" else arm.base
        mount = camera.mount
        self._link = self._wanted.link or (mount.link if mount is not None else usual)
        self._frame = mount.frame if mount is not None else f"{self._name}_optical_frame"
        arm.link(self._link, self._eye)
        self._arm = arm

    def read(self, path: Path) -> None:
        """Take the views of a recording."""
        for file in map(open_recording, recordings_of(path)):
            if self._camera is None:
                self._prepare(read_profile(file.profile_yaml, f"the profile in {file.path}"))
            reported = read_recording(file, self.sampler, self._name, self._arm, self._tell)
            self._reported = reported or self._reported

    def watch(self, client: Client) -> None:
        """Take views off the bus until there are enough, or a person ends it."""
        self._prepare(client.profile)
        live = Live(client, self.sampler, self._name, self._arm, self._tell, jpeg=self._way.jpeg)
        try:
            live.pump(1.0, images=False)
            if self._way.tour or self._way.tour_file is not None:
                self._go_around(client, live)
            else:
                self._follow_hand(live)
        except KeyboardInterrupt:
            self._tell(f"ended with {len(self.sampler.taken)} views")
        self._reported = live.lens

    def _follow_hand(self, live: Live) -> None:
        """A person moves the arm, or the board."""
        self._tell("move, let it stand for a second, move on; Ctrl-C ends it")
        told = -1
        while missing := self.sampler.missing(self._way.views):
            count = len(self.sampler.taken)
            if count != told:
                told = count
                self._tell(f"missing: {'; '.join(missing)}")
            # The gripper may hide a part of every image: that alone asks for no more views.
            if count >= self._way.views and not any("arm" in one for one in missing):
                return
            if not self._way.enter:
                live.pump(0.5)
                continue
            live.pump(0.2, images=False)
            if select.select([sys.stdin], [], [], 0.0)[0]:
                sys.stdin.readline()
                outcomes = live.pump(DWELL_S)
                if not any(isinstance(one, Taken) for one in outcomes):
                    why = outcomes[-1] if outcomes else None
                    said = "no image came" if why is None or isinstance(why, Taken) else why.why
                    self._tell(f"not taken: {said}")

    def _go_around(self, client: Client, live: Live) -> None:
        """The arm goes through the poses of a tour, as `vla-zenoh do move-to` would."""
        client.profile.require_one_arm("camera calibrate --tour")
        assert self._arm is not None
        assert self._eye is not None
        if self._way.tour_file is not None:
            count = len(client.profile.robot.arm_joints)
            targets = [{"joints_rad": list(row)} for row in read_joints(self._way.tour_file, count)]
        else:
            start = self.sampler.newest_pose()
            targets = [
                {
                    "position_m": pose[:3, 3].tolist(),
                    "quat_xyzw": quat_from_rotation(pose[:3, :3]).tolist(),
                }
                for pose in tour(start, self._eye, self._way.ahead_m, self._way.views)
            ]
        speed = client.profile.limits.approach_m_s
        typer.confirm(
            f"activate the arm and move it to {len(targets)} poses, at {speed:g} m/s at most?",
            abort=True,
            err=True,
        )
        failed = 0
        for number, fields in enumerate(targets, 1):
            answer = ask(client, "move_to", {**fields, "timeout_s": MOVE_S}, who="calibrate")
            if answer.ok:
                failed = 0
                live.pump(DWELL_S)
                continue
            self._tell(f"pose {number} left out: {answer.reason} {answer.why}".rstrip())
            failed += 1
            if client.stop_latched() or failed == MAX_FAILED:
                raise CalibrationError(f"the tour ended after {MAX_FAILED} poses in a row failed")

    def calibrated(self) -> Calibration:
        """The calibration by the views that were taken."""
        self.sampler.require_some()
        views, size = self.sampler.views, self.sampler.size
        assert size is not None
        assert self._camera is not None
        lens = self._known_lens(size)
        quality = None if lens is not None else calibrate_lens(self._board, views, size)
        best = lens if quality is None else quality.intrinsics
        assert best is not None
        place, mount = None, None
        if self._eye is not None:
            assert self._arm is not None
            information = None if quality is None else quality.information
            place = calibrate_hand_eye(self._board, views, best, self._eye, information=information)
            best = place.lens
            link = self._arm.link(self._link, self._eye)
            mount = mount_of(place, link, self._link, self._frame)
        return Calibration(self._name, self._camera.source, len(views), best, quality, place, mount)

    def _known_lens(self, size: tuple[int, int]) -> Intrinsics | None:
        """The lens that is kept, of images of this size; None: it is calibrated."""
        width, height = size
        if (path := self._wanted.lens) is not None:
            lens = read_intrinsics(path)
            if abs(lens.width * height / (lens.height * width) - 1.0) > SAME_ASPECT:
                raise CalibrationError(
                    f"{path} is of images of {lens.width}x{lens.height}, those of camera "
                    f"{self._name} are {width}x{height}: another shape, no scaling makes it fit"
                )
            return lens.scaled(width, height)
        if not self._wanted.keep_lens:
            return None
        told = dict(self._reported)
        if not told:
            raise CalibrationError(
                f"the node of camera {self._name} reports no lens: give its file with --lens, or "
                "leave --keep-lens out and calibrate it"
            )
        bend = tuple(told.pop(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
        return Intrinsics(width=width, height=height, distortion=bend if any(bend) else (), **told)

    def picture(self, found: Calibration) -> NDArray[np.uint8]:
        """The view with the most corners, with the frames of arm and board."""
        best = max(self.sampler.taken, key=lambda one: len(one.view.ids))
        view = best.view
        frames = {"board": board_pose(self._board, view, found.lens)}
        place = found.place
        if place is not None and view.arm is not None:
            frames |= arm_frames(place, view.arm)
            held = frames["tcp" if place.eye == "in-hand" else "base"]
            if self._arm is not None and self._link not in (self._arm.tcp, self._arm.base):
                frames[self._link] = held @ self._arm.link(self._link, place.eye)
        return with_frames(best.image, found.lens, frames)


def _require_whole_images(name: str, camera: CameraProfile) -> None:
    """The profile's lens is of the camera's own images, which are not on the bus then."""
    for setting, usual in (("crop", None), ("flip", "none"), ("undistort", False)):
        if getattr(camera, setting) != usual:
            raise CalibrationError(
                f"cameras.{name}.{setting} is set, and a lens is of the camera's own images: take "
                "it out while you calibrate, or keep the lens (--keep-lens)"
            )


def _say_result(found: Calibration, folder: Path) -> None:
    say(found.summary())
    if (place := found.place) is not None:
        say(
            f"corners {place.rms_px:.2f} px (rms), {place.worst_px:.2f} px in view "
            f"{place.worst + 1}, the worst; board by image and by arm {place.rms_m * 1e3:.2f} mm, "
            f"{place.rms_rad * 1e3:.2f} mrad apart (rms)"
        )
        say(f"a square by the arm's motion: {place.square_m * 1e3:.2f} mm")
    elif found.quality is not None:
        say(f"focal length {found.lens.fx_px:.1f} px, +- {found.quality.focal_sd_px:.1f}")
    if found.quality is not None and not found.has_lens:
        kind = found.source.partition(":")[0]
        say(f"the lens is not for the profile: {kind}: cameras report their own")
    say(f"it holds for images of {found.lens.width}x{found.lens.height}, and scaled ones of them")
    say(f"results: {folder} (profile.yaml, frames.jpg)")


def _write(path: Path, found: Calibration, tell: Callable[[str], None]) -> None:
    """Write the keys into a profile, and the lens beside it."""
    if not path.is_file():
        raise CalibrationError(f"{path} is no file: --write wants the path of your profile")
    profile, keys = path, found.keys()
    if not keys:
        raise CalibrationError("nothing to write: the source of this camera takes no lens")
    if found.has_lens:
        lens = profile.with_name(f"{profile.stem}_{found.lens_name}")
        keys["intrinsics"] = lens.name
        if lens.exists():
            tell(f"before: {backup(lens)}")
        lens.write_text(found.lens_file(), "utf-8")
        tell(f"{lens}: the lens")
    older = write_profile(profile, ("cameras", found.camera), keys)
    for key in keys:
        tell(f"{profile}: cameras.{found.camera}.{key} is set")
    tell(f"before: {older}")
