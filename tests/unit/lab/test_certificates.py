"""Certificates: what they say, who may use them, and that nothing is overwritten or left open."""

from __future__ import annotations

import codecs
import datetime as dt
import json
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from typer.testing import CliRunner
from vla_zenoh_secure import authority as ca
from vla_zenoh_secure.lab_certificates import LabCertificates
from vla_zenoh_secure.secure_profile import (
    moved_hosts,
    profile_text,
    serving_addresses,
    with_operator,
)

from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.program.main import app
from vla_zenoh.security import certificates
from vla_zenoh.security.certificates import unfit_certificates
from vla_zenoh.security.roles import Identity, Role, identities, operator_identities

NOW = dt.datetime(2026, 3, 1, 12, tzinfo=dt.UTC)
ROUTER = Identity(Role.ROUTER, "router", "robot")
WORKER = Identity(Role.WORKER, "worker-scripted", "gpu", worker="scripted")
runner = CliRunner()


@pytest.fixture(scope="module")
def authority() -> ca.KeyPair:
    return ca.make_authority("test lab", NOW)


@pytest.fixture
def store(tmp_path: Path) -> LabCertificates:
    made = LabCertificates(tmp_path / "lab")
    made.make_authority("test lab", NOW)
    return made


# -- certificates -----------------------------------------------------------------------------
def test_a_certificate_says_whose_it_is_and_who_signed_it(authority: ca.KeyPair) -> None:
    made = ca.issue(authority, "worker-scripted@gpu", NOW)
    found = certificates.read(made.certificate)
    assert found.common_name == "worker-scripted@gpu"
    raw = x509.load_pem_x509_certificate(made.certificate)
    assert raw.issuer.rfc4514_string() == "CN=test lab"
    assert not raw.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert found.days_left(NOW) == ca.CERTIFICATE_DAYS
    assert certificates.signed_by(made.certificate, authority.certificate)
    own, key = certificates.load_pair(*made)
    assert own.public_key() == key.public_key()
    _, key = certificates.load_pair(made.certificate, authority.key)
    assert own.public_key() != key.public_key()


def test_another_authority_of_the_same_name_signed_something_else(authority: ca.KeyPair) -> None:
    other = ca.make_authority("test lab", NOW)
    made = ca.issue(other, "operator@desk", NOW)
    assert not certificates.signed_by(made.certificate, authority.certificate)


def usages(pem: bytes) -> list[x509.ObjectIdentifier]:
    found = x509.load_pem_x509_certificate(pem)
    return list(found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)


def test_only_a_router_may_serve(authority: ca.KeyPair) -> None:
    router = ca.issue(authority, "router@robot", NOW, addresses=["10.0.0.2", "robot.lab", "::1"])
    assert certificates.read(router.certificate).addresses == ("10.0.0.2", "robot.lab", "::1")
    assert ExtendedKeyUsageOID.SERVER_AUTH in usages(router.certificate)
    worker = ca.issue(authority, "worker-scripted@gpu", NOW)
    assert usages(worker.certificate) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert certificates.read(worker.certificate).addresses == ()


def test_nothing_outlives_the_authority() -> None:
    short = ca.make_authority("test lab", NOW, days=10)
    assert certificates.read(ca.issue(short, "a@b", NOW).certificate).days_left(NOW) == 10
    with pytest.raises(SecurityError, match="authority expired on 2026-03-11: make a new one"):
        ca.issue(short, "a@b", NOW + dt.timedelta(days=11))


@pytest.mark.parametrize(
    ("days", "fault", "warning"),
    [
        (-1, "is not valid before 2026-03-01 11:50 UTC (is the clock right?)", ""),
        (0, "", ""),
        (320, "", ""),
        (336, "", "ends in 29 days; renew it"),
        (364, "", "ends in 1 day; renew it"),
        (366, "expired on 2027-03-01; renew it", ""),
    ],
)
def test_the_end_of_a_certificate_is_told_in_time(
    authority: ca.KeyPair, days: int, fault: str, warning: str
) -> None:
    found = certificates.read(ca.issue(authority, "a@b", NOW).certificate)
    then = NOW + dt.timedelta(days=days)
    assert found.fault(then) == fault
    assert found.warning(then) == warning


def test_a_name_that_no_certificate_can_hold_is_refused(authority: ca.KeyPair) -> None:
    with pytest.raises(SecurityError, match="give 1 to 64 characters"):
        ca.issue(authority, f"worker-{'x' * 60}@gpu", NOW)
    with pytest.raises(SecurityError, match="no host name and no IP address"):
        ca.issue(authority, "router@robot", NOW, addresses=["räuber"])


def test_what_is_no_certificate_is_refused() -> None:
    with pytest.raises(SecurityError, match="not a certificate"):
        certificates.read(b"hello")


# -- the folder -------------------------------------------------------------------------------
def test_private_keys_are_their_owners_alone(store: LabCertificates) -> None:
    store.add([ROUTER, WORKER], NOW, addresses=["10.0.0.2"])
    keys = sorted(store.folder.rglob("*.key"))
    assert [path.name for path in keys] == ["ca.key", "worker-scripted.key", "router.key"]
    for path in keys:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def test_nothing_is_overwritten_unless_asked_for(store: LabCertificates) -> None:
    store.add([WORKER], NOW)
    files = store.files("gpu", "worker-scripted")
    before = files.certificate.read_bytes(), files.key.read_bytes()
    with pytest.raises(SecurityError, match=r"ca\.pem is there already and is not overwritten"):
        store.make_authority("another", NOW)
    new = Identity(Role.WORKER, "worker-replay", "gpu", worker="replay")
    with pytest.raises(SecurityError, match=r"worker-scripted\.pem is there already"):
        store.add([new, WORKER], NOW)
    assert not store.files("gpu", "worker-replay").certificate.exists()  # all or nothing
    assert (files.certificate.read_bytes(), files.key.read_bytes()) == before
    store.add([WORKER], NOW, renew=True)
    assert files.certificate.read_bytes() != before[0]
    assert [entry.faults for entry in store.entries(NOW)] == [(), ()]


def test_certificates_are_made_where_the_authority_is(
    store: LabCertificates, tmp_path: Path
) -> None:
    with pytest.raises(SecurityError, match="begin with `vla-zenoh secure init`"):
        LabCertificates(tmp_path / "empty").add([WORKER], NOW)
    (store.folder / "ca.key").unlink()
    with pytest.raises(SecurityError, match="made on the computer where"):
        store.add([WORKER], NOW)


def test_a_key_that_others_can_read_is_not_used(store: LabCertificates) -> None:
    store.add([WORKER], NOW)
    key = store.files("gpu", "worker-scripted").key
    key.chmod(0o640)
    with pytest.raises(SecurityError, match=r"can be read by others \(mode 640\): chmod 600"):
        store.identity_files("gpu", "worker-scripted")
    assert any("chmod 600" in fault for entry in store.entries(NOW) for fault in entry.faults)


def test_an_authority_whose_key_others_can_read_signs_nothing(store: LabCertificates) -> None:
    (store.folder / "ca.key").chmod(0o644)
    with pytest.raises(SecurityError, match=r"ca\.key can be read by others \(mode 644\)"):
        store.add([WORKER], NOW)
    assert not store.has("gpu", "worker-scripted")


def test_beside_keys_whose_authority_is_not_there_no_second_one_is_made(
    store: LabCertificates,
) -> None:
    store.add([WORKER], NOW)
    for file in ("ca.key", "ca.pem", "gpu/ca.pem"):
        (store.folder / file).unlink()
    with pytest.raises(SecurityError, match=r"gpu/worker-scripted\.key is of an authority that is"):
        store.make_authority("again", NOW)
    assert not (store.folder / "ca.key").exists()
    done = runner.invoke(app, ["secure", "show", "--folder", str(store.folder)])
    assert done.exit_code == 1
    assert "gpu lacks ca.pem: copy this host's folder from the computer" in done.output


def test_a_router_that_is_renewed_serves_where_it_served(store: LabCertificates) -> None:
    store.add([ROUTER], NOW, addresses=["10.0.0.2"])
    store.add([ROUTER], NOW, addresses=["robot.lab"], renew=True)
    (entry,) = store.entries(NOW, "robot")
    assert entry.certificate is not None
    assert sorted(entry.certificate.addresses) == ["10.0.0.2", "robot.lab"]


def test_a_computer_knows_which_host_it_is_when_it_has_one_folder(store: LabCertificates) -> None:
    with pytest.raises(SecurityError, match="has no certificates"):
        store.this_host(None)
    store.add([WORKER], NOW)
    assert store.this_host(None) == "gpu"
    store.add([ROUTER], NOW)
    with pytest.raises(SecurityError, match=r"of gpu, robot: say which of them .*--host"):
        store.this_host(None)
    assert store.this_host("robot") == "robot"
    with pytest.raises(SecurityError, match=r"Here are those of: gpu, robot\."):
        store.identity_files("robto", "router")


def test_a_computer_with_certificates_of_several_hosts_notes_which_it_is(
    store: LabCertificates,
) -> None:
    store.add([WORKER, ROUTER], NOW)
    note = store.remember_host("robot")
    assert store.this_host(None) == "robot"
    assert store.this_host("gpu") == "gpu"
    assert store.identity_files(None, "router").certificate.parent.name == "robot"
    # Folders of hosts are copied, and none of them holds it.
    assert note.parent == store.folder
    assert store.hosts() == ["gpu", "robot"]
    store.remember_host("attic")
    assert store.known_host() is None


def test_people_are_the_operator_where_there_is_one_else_the_viewer(store: LabCertificates) -> None:
    store.add([Identity(Role.VIEWER, "viewer", "desk")], NOW)
    assert store.identity_files("desk", None).certificate.name == "viewer.pem"
    store.add([Identity(Role.OPERATOR, "operator", "desk")], NOW)
    assert store.identity_files("desk", None).certificate.name == "operator.pem"
    with pytest.raises(SecurityError, match=r"camera\.pem is not there\. Make it with `vla-zenoh"):
        store.identity_files("desk", "camera")


def test_people_who_were_given_less_show_that_and_are_told_what_else_lies_there(
    store: LabCertificates,
) -> None:
    store.add(
        [*operator_identities("desk", Role.OPERATOR), *operator_identities("desk", Role.VIEWER)],
        NOW,
    )
    security = {"folder": str(store.folder), "people": {"desk": "viewer"}}
    tls = ["tls/10.0.0.2:7447"]
    session = {"listen": tls, "connect": tls, "security": security}
    lab = override(load_profile("panda_sim"), {"session": session})
    found = store.identity_files("desk", None, {"desk": "viewer"})
    assert found.certificate.name == "viewer.pem"
    told = unfit_certificates(lab, store.entries(NOW))
    assert sorted(path.name for path in told) == ["operator.pem", "worker-teleop.pem"]
    assert "where people at desk are viewer: delete it" in told[store.folder / "desk/operator.pem"]
    found.certificate.unlink()
    with pytest.raises(SecurityError, match=r"viewer\.pem is not there"):
        store.identity_files("desk", None, {"desk": "viewer"})


def test_a_router_that_has_another_address_than_its_certificate_is_told(
    store: LabCertificates,
) -> None:
    def lab(*endpoints: str) -> Profile:
        session = {"listen": ["tls/0.0.0.0:7447"], "connect": [*endpoints]}
        secured = {**session, "security": {"folder": str(store.folder)}}
        return override(load_profile("panda_sim"), {"session": secured})

    before, after = lab("tls/10.0.0.2:7447"), lab("tls/10.0.0.2:7447", "tls/robot.lab:7447")
    store.add(identities(before), NOW, addresses=serving_addresses(before))
    entries = store.entries(NOW)
    assert unfit_certificates(before, entries) == {}
    ((path, why),) = unfit_certificates(after, entries).items()
    assert path.name == "router.pem"
    assert why.startswith("is not valid for robot.lab, where panda_sim looks for a router")


def test_what_is_wrong_with_each_file_is_told(store: LabCertificates) -> None:
    store.add([WORKER, ROUTER], NOW)
    good = store.files("gpu", "worker-scripted")
    bad = store.files("robot", "router")
    bad.certificate.write_bytes(good.certificate.read_bytes())
    (bad.certificate.parent / "old.pem").write_text("-----BEGIN rubbish")
    marked = bad.certificate.parent / "marked.pem"
    marked.write_bytes(codecs.BOM_UTF8 + good.certificate.read_bytes())
    faults = {entry.path.name: "; ".join(entry.faults) for entry in store.entries(NOW)}
    assert faults["ca.pem"] == faults["worker-scripted.pem"] == ""
    assert "is about 'worker-scripted@gpu'" in faults["router.pem"]
    assert "router.key belongs to another certificate" in faults["router.pem"]
    assert "not a certificate" in faults["old.pem"]
    assert "no line that begins with -----BEGIN" in faults["marked.pem"]


# -- the profile ------------------------------------------------------------------------------
def test_a_secured_profile_says_tls_everywhere_and_where_the_routers_are(tmp_path: Path) -> None:
    plain = load_profile("panda_sim_two_sites")
    places = moved_hosts(plain, {"robot": "10.0.0.2", "spare": "fd00::3", "gpu": "gpu.lab"})
    file = tmp_path / "lab.yaml"
    file.write_text(profile_text(plain, "panda_sim_two_sites", tmp_path / "keys", places))
    found = load_profile(str(file))
    assert found.session.listen == ("tls/10.0.0.2:7447",)
    assert found.session.connect == ("tls/10.0.0.2:7447", "tls/[fd00::3]:7457")
    assert found.hosts["gpu"].link == found.session.connect
    assert found.hosts["gpu"].connect == ("tls/gpu.lab:7467",)
    assert {name: host.nodes for name, host in found.hosts.items()} == {
        name: host.nodes for name, host in plain.hosts.items()
    }
    with pytest.raises(SecurityError, match="no router runs on 'desk'; it does on: robot, spare"):
        moved_hosts(plain, {"desk": "10.0.0.9"})


@pytest.mark.parametrize("name", ["panda_sim", "panda_sim_two_hosts", "panda_sim_lab"])
def test_people_are_added_one_by_one_and_can_change(name: str, tmp_path: Path) -> None:
    file, plain = tmp_path / "lab.yaml", load_profile(name)
    text = profile_text(plain, name, tmp_path / "keys")
    text += "# a remark that stays\n"
    for host, role in (("desk", Role.VIEWER), ("wall", Role.VIEWER), ("desk", Role.OPERATOR)):
        text = with_operator(text, host, role)
    file.write_text(text)
    security = load_profile(str(file)).session.security
    assert security is not None
    assert security.people == {"desk": "operator", "wall": "viewer"}
    assert text.endswith("# a remark that stays\n")


def test_a_profile_without_the_list_is_left_alone() -> None:
    with pytest.raises(SecurityError, match="Write it by hand:\nsession:\n  security:\n    people"):
        with_operator("session: {security: {}}\n", "desk", Role.VIEWER)


# -- the command ------------------------------------------------------------------------------
def test_a_profile_that_cannot_be_secured_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "keys"
    done = runner.invoke(app, ["secure", "init", "-p", "panda_ros2", "--folder", str(folder)])
    assert done.exit_code == 1
    assert "ros2.connect: is missing: in a secured lab the bridge" in str(done.exception)
    assert list(tmp_path.iterdir()) == []


def test_a_lab_is_secured_by_one_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "keys"
    init = ["init", "--profile", "panda_sim_two_hosts", "--folder", str(folder)]
    done = runner.invoke(app, ["secure", *init, "--at", "robot=10.0.0.2"])
    assert done.exit_code == 0, done.output
    secured = "panda_sim_two_hosts_secure.yaml"
    assert load_profile(secured).session.listen == ("tls/10.0.0.2:7447",)
    assert sorted(path.name for path in (folder / "gpu").iterdir()) == [
        "ca.pem",
        "viewer.key",
        "viewer.pem",
        "worker-scripted.key",
        "worker-scripted.pem",
    ]
    lines = done.output.splitlines()
    at = lines.index(f"  ssh gpu mkdir -p {folder}")
    assert lines[at + 1 : at + 3] == [
        f"  scp -rp {folder}/gpu gpu:{folder}/",
        f"  scp {secured} gpu:",
    ]
    assert f"There: vla-zenoh up ./{secured} --host NAME" in lines
    again = runner.invoke(app, ["secure", *init])
    assert again.exit_code == 1

    add = ["add", "desk", "--role", "operator", "--profile", secured]
    done = runner.invoke(app, ["secure", *add])
    assert done.exit_code == 0, done.output
    assert f"  scp -rp {folder}/desk desk:{folder}/" in done.output.splitlines()
    assert f"To watch, there: vla-zenoh status --profile ./{secured}" in done.output
    assert " up " not in done.output
    assert (folder / "desk" / "operator.pem").exists()

    done = runner.invoke(app, ["secure", "show", "--profile", secured, "--json"])
    assert done.exit_code == 0, done.output
    shown = json.loads(done.stdout)
    assert {(one["host"], one["node"]) for one in shown} >= {
        ("", "ca"),
        ("desk", "operator"),
        ("robot", "router"),
        ("gpu", "worker-scripted"),
    }
    router = next(one for one in shown if one["node"] == "router")
    assert "10.0.0.2" in router["addresses"]
    assert all(one["faults"] == [] and one["days_left"] >= 364 for one in shown)

    (folder / "desk" / "operator.key").chmod(0o644)
    done = runner.invoke(app, ["secure", "show", "--profile", secured])
    assert done.exit_code == 1
