"""Which device of Video4Linux a profile means, in folders as Linux makes them."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.v4l2_devices import find_device, list_devices


class Host:
    """A computer with cameras."""

    def __init__(self, folder: Path) -> None:
        self.dev, self.sys, self._usb = folder / "dev", folder / "sys", folder / "usb"
        (self.dev / "v4l" / "by-id").mkdir(parents=True)
        self.sys.mkdir()

    def plug(self, number: int, name: str, serial: str = "", *, index: int = 0) -> Path:
        path = self.dev / f"video{number}"
        path.touch()
        interface = self._usb / f"{name}-{serial}-{number}" / "1.0"
        interface.mkdir(parents=True)
        if serial:
            (interface.parent / "serial").write_text(f"{serial}\n")
            link = self.dev / "v4l" / "by-id" / f"usb-{name}_{serial}-video-index{index}"
            if not link.exists():
                link.symlink_to(path)
        folder = self.sys / path.name
        folder.mkdir()
        (folder / "name").write_text(f"{name}\n")
        (folder / "index").write_text(f"{index}\n")
        (folder / "device").symlink_to(interface)
        return path

    def unplug(self, path: Path) -> None:
        path.unlink()
        for file in (self.sys / path.name).iterdir():
            file.unlink()
        (self.sys / path.name).rmdir()
        for link in (self.dev / "v4l" / "by-id").iterdir():
            if not link.exists():
                link.unlink()

    def find(self, wanted: str) -> Path:
        return find_device(wanted, self.dev, self.sys)


@pytest.fixture
def host(tmp_path: Path) -> Host:
    return Host(tmp_path)


def test_a_camera_is_found_by_serial_number_by_name_by_number_and_by_path(host: Host) -> None:
    host.plug(0, "Left", "SN0001")
    wrist = host.plug(2, "Wrist", "200901010001")
    for wanted in ("200901010001", "usb-Wrist_200901010001-video-index0", "Wrist_200901010001"):
        assert host.find(wanted) == wrist
    assert host.find("2") == wrist
    assert host.find(str(wrist)) == wrist


def test_a_camera_that_comes_back_under_another_number_is_the_same_camera(host: Host) -> None:
    host.unplug(host.plug(0, "Left", "A"))
    host.plug(0, "Right", "B")
    again = host.plug(4, "Left", "A")
    assert host.find("A") == again
    assert host.find("B") == host.dev / "video0"


def test_the_list_says_what_to_write_and_leaves_out_devices_without_images(host: Host) -> None:
    host.plug(10, "Cheap")
    host.plug(0, "Good", "SN1")
    host.plug(1, "Good", "SN1", index=1)
    listed = list_devices(host.dev, host.sys)
    assert [(one.source, one.name) for one in listed] == [
        ("v4l2:SN1", "Good"),
        (f"v4l2:{host.dev}/video10", "Cheap"),
    ]


def test_a_serial_number_that_is_not_there_or_is_twice_is_an_error(host: Host) -> None:
    with pytest.raises(NodeError, match="cameras here: none"):
        host.find("SN9")
    host.plug(0, "Good", "SN1")
    with pytest.raises(NodeError, match=r"cameras here: v4l2:SN1 \(Good\)"):
        host.find("SN9")
    host.plug(2, "Good", "SN1")
    with pytest.raises(NodeError, match=r"video0, .*video2 all have the serial number 'SN1'"):
        host.find("SN1")


def test_a_computer_without_video_has_no_cameras(tmp_path: Path) -> None:
    assert list_devices(tmp_path / "dev", tmp_path / "sys") == []
