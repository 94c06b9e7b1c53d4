"""The page in headless Chromium at a robot at work: what a person touches, and what follows."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from camera_rig import PATIENCE_S, until
from chain import Chain, running_chain, write_profile
from web_rig import OPERATOR, Site, serving, write_people

pytest.importorskip("starlette", reason="needs vla-zenoh-web")
webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")
if not (CHROMIUM.exists() and DRIVER.exists()):
    pytest.skip("needs Debian's chromium and chromium-driver", allow_module_level=True)

from selenium.webdriver.chrome.service import Service  # noqa: E402

pytestmark = pytest.mark.slow
HOSTS = """\
hosts:
  here: {nodes: [router, sim, camera, command, worker, primitives]}
"""


@pytest.fixture(scope="module")
def shared_chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("chain")
    file = write_profile(folder, more=HOSTS)
    file.write_text(file.read_text().replace("  wrist: null", DEPTH))
    with running_chain(folder, profile_file=file, rolling=folder / "rolling") as chain:
        chain.activate_when_ready()
        yield chain


DEPTH = """\
  wrist: {source: "sim:wrist", width: 160, height: 120, rate_hz: 20, depth_unit_m: 0.001}"""


@pytest.fixture(scope="module")
def site(shared_chain: Chain, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    people = write_people(tmp_path_factory.mktemp("people"))
    with serving(shared_chain.profile_file, people) as site:
        yield site


class Tab:
    """A tab of Chromium with the page open."""

    KEY_LEFT, ENTER = "\ue012", "\ue007"
    """Keys in WebDriver's code."""

    def __init__(self, driver: Any, site: Site) -> None:
        self.driver = driver
        driver.get(f"http://{site.host}/#{OPERATOR}")
        self.until("it is connected", lambda: self.text("link") == "connected")

    def text(self, name: str) -> str:
        return self.run(f"return document.getElementById('{name}').textContent")

    def run(self, script: str) -> Any:
        return self.driver.execute_script(script)

    def until(self, what: str, ask: Any, patience_s: float = PATIENCE_S) -> Any:
        return until(what, ask, patience_s)

    def button(self, words: str) -> Any:
        """The button, or link, with these words or this name for screen readers."""
        path = f"//*[self::button or self::a][normalize-space()='{words}' or @aria-label='{words}']"
        return self.until(words, lambda: self.driver.find_elements("xpath", path))[0]

    def click(self, words: str) -> None:
        self.until(f"{words} is enabled", lambda: self.button(words).is_enabled())
        self.driver.execute_script(
            "arguments[0].scrollIntoView({block: 'center'}); arguments[0].click()",
            self.button(words),
        )

    def put(self, name: str, text: str, *events: str) -> None:
        """Fill a field, as if typed."""
        words = [f"f.dispatchEvent(new Event('{event}', {{bubbles: true}}))" for event in events]
        self.run(
            f"const f = document.getElementById('{name}'); f.value = '{text}'; " + ";".join(words)
        )

    def reasons(self) -> list[str]:
        """Reasons of a rejected activation."""
        return self.run(
            "return [...document.querySelectorAll('#answer li')].map((one) => one.textContent)"
        )

    def press(self, words: str) -> None:
        """Touch a button and keep it, by Chromium's own input."""
        self._touch("touchStart", words)

    def let_go(self) -> None:
        self._touch("touchEnd", "")

    def _touch(self, kind: str, words: str) -> None:
        points = []
        if words:
            self.until(f"{words} is enabled", lambda: self.button(words).is_enabled())
            x, y = self.driver.execute_script(
                "arguments[0].scrollIntoView({block: 'center'});"
                "const b = arguments[0].getBoundingClientRect();"
                "return [b.x + b.width / 2, b.y + b.height / 2]",
                self.button(words),
            )
            points = [{"x": x, "y": y}]
        self.driver.execute_cdp_cmd(
            "Input.dispatchTouchEvent", {"type": kind, "touchPoints": points}
        )

    def complaints(self) -> list[str]:
        """What Chromium says of the page: violations of its policy, errors of its script."""
        found = self.driver.get_log("browser")
        return [line["message"] for line in found if line["level"] == "SEVERE"]


@pytest.fixture
def tab(site: Site) -> Iterator[Tab]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--mute-audio"):
        options.add_argument(word)
    options.add_argument("--window-size=1440,1000")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as data:
        options.add_argument(f"--user-data-dir={data}")
        driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
        try:
            tab = Tab(driver, site)
            yield tab
            # The page of a report has another origin: it gets no icon of ours.
            assert not [line for line in tab.complaints() if "favicon" not in line]
        finally:
            driver.quit()


def test_settings_are_those_of_the_page(chain: Chain, tab: Tab) -> None:
    def said(field: str) -> Any:
        return getattr(chain.client.task, field)

    tab.put("prompt", "HARD: go up", "input")
    tab.click("Set")
    tab.until("the prompt", lambda: said("prompt") == "HARD: go up")
    for text, rate_hz in (("4", 4.0), ("5", 5.0)):
        tab.put("rate", text, "change")
        tab.until("the rate", lambda wanted=rate_hz: said("rate_hz") == wanted)
    for text, percent in (("50", 50), ("100", 100)):
        tab.put("speed", text, "change")
        tab.until("the speed", lambda wanted=percent: said("speed_percent") == wanted)


def test_a_rejected_activation_lists_every_reason(chain: Chain, tab: Tab) -> None:
    tab.click("Deactivate")
    tab.until("it stands", lambda: "stands" in tab.text("facts"))
    chain.client.set_worker("nobody")
    tab.click("Activate")
    tab.until("the reasons", lambda: any("nobody" in reason for reason in tab.reasons()))
    chain.client.set_worker("scripted")


def test_the_arm_moves_while_the_button_is_held_and_the_page_says_who_holds(
    chain: Chain, tab: Tab
) -> None:
    tab.click("Deactivate")
    chain.client.set_prompt("HARD: go up" if chain.height_m() < 0.42 else chain.down)

    def held() -> bool:
        tab.press("Hold to run")
        answer = tab.until("an answer", lambda: tab.text("answer"))
        if not answer.startswith("active"):
            tab.let_go()
        return answer.startswith("active")

    tab.until("it is active", held, 60.0)
    chain.until("it moves", chain.moves)
    tab.until("the page has it", lambda: "held byyou" in tab.text("facts"))
    assert tab.text("do") == "Let go to brake."
    tab.let_go()
    chain.wait_still()
    tab.until("nobody has it", lambda: "held bynobody" in tab.text("facts"))


def test_holding_is_the_most_prominent_way_to_run(tab: Tab) -> None:
    def colour(name: str) -> str:
        return tab.run(f"return getComputedStyle({name}).backgroundColor")

    accent = colour("document.querySelector('button[aria-pressed=true]:not(.picture)')")
    hold = "document.getElementById('hold')"
    assert colour(hold) == accent
    assert colour("document.getElementById('activate')") != accent
    first = tab.run("return [...document.querySelectorAll('button')].slice(0, 3).map((b) => b.id)")
    assert {"hold", "stop"} <= {*first}


def test_a_touch_enlarges_a_picture_and_leaves_stop_in_reach(tab: Tab) -> None:
    tab.until("a picture", lambda: tab.run("return shown.has('camera/front')"))
    small = tab.run("return shown.get('camera/front').canvas.clientWidth")
    tab.click("picture of front, large")
    assert tab.run("return shown.get('camera/front').canvas.clientWidth") > 2 * small
    above = (
        "const b = document.getElementById('stop').getBoundingClientRect();"
        "return document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2).id"
    )
    assert tab.run(above) == "stop"
    tab.button("picture of front, large").send_keys(tab.ENTER)
    assert tab.run("return shown.get('camera/front').canvas.clientWidth") == small


def test_the_last_minute_is_told_in_words_and_drawn(chain: Chain, tab: Tab) -> None:
    def captions() -> list[str]:
        return tab.run(
            "return [...document.querySelectorAll('#lines figcaption')].map((c) => c.textContent)"
        )

    tab.until("a speed", lambda: " cm/s; at most " in captions()[0])
    assert captions()[3].startswith("limits: ")
    painted = (
        "const c = document.querySelector('#lines canvas');"
        "return c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((v) => v)"
    )
    tab.until("a line", lambda: tab.run(painted))


def test_a_stop_buzzes_says_when_the_arm_stood_and_offers_the_reset(chain: Chain, tab: Tab) -> None:
    tab.run(
        "window.felt = []; navigator.vibrate = (pattern) => { felt.push(pattern); return true; }"
    )
    for button in ("3-D", "STOP"):  # browsers let no page buzz that was never touched
        tab.press(button)
        tab.let_go()
    tab.until("when it stood", lambda: "stood at" in tab.text("stop-words"))
    assert len(tab.run("return felt")) == 2
    tab.until("the banner", lambda: tab.text("what") == "Emergency stop. The arm stands.")
    tab.click("Reset")
    tab.until("it is cleared", lambda: chain.state() == "inactive")
    tab.until(
        "the reset is gone", lambda: tab.run("return document.getElementById('reset').hidden")
    )


def test_the_page_says_who_is_here_and_lets_a_person_leave(tab: Tab) -> None:
    tab.until("anna", lambda: "anna, operator" in tab.text("here"))
    tab.click("Sign out")
    assert tab.run("return document.getElementById('enter').open")
    assert not tab.run("return sessionStorage.getItem('token')")
    assert tab.run("return document.getElementById('hold').disabled")


def test_a_person_is_invited_by_a_link_of_their_own(site: Site, tab: Tab) -> None:
    tab.put("invite-name", "bob")
    tab.run("document.getElementById('invite-role').value = 'viewer'")
    tab.click("Invite")
    link = tab.until(
        "the link", lambda: tab.run("return document.getElementById('invited-link').value")
    )
    assert link.startswith(f"http://{site.host}/#")
    tab.driver.switch_to.new_window("window")
    tab.driver.get(link)
    tab.until("bob is in", lambda: tab.text("who") == "bob, viewer")
    tab.until("both are named", lambda: tab.text("here") == "anna, operatorbob, viewer")
    assert tab.run("return document.getElementById('hold').disabled")


def test_the_guide_leads_to_a_data_set(chain: Chain, tab: Tab) -> None:
    chain.activate_when_ready()
    tab.click("Deactivate")
    chain.wait_still()
    tab.put("guide-prompt", "HARD: go up" if chain.height_m() < 0.42 else chain.down)
    tab.put("guide-count", "1")
    tab.click("Begin")
    tab.click("Take")
    tab.until("it records", lambda: "is being recorded" in tab.text("guide-words"), 30.0)

    def held() -> bool:
        tab.press("Hold to run")
        try:
            return tab.until("it moves", chain.moves, 5.0)
        except AssertionError:
            tab.let_go()
            return False

    tab.until("a run", held, 60.0)
    tab.let_go()
    tab.click("It succeeded")
    tab.until(
        "a data set", lambda: "/dataset: 1 episodes (1 success)" in tab.text("guide-words"), 60.0
    )
    assert (
        tab.run("return document.querySelector('#steps [aria-current]').textContent") == "Data set"
    )


def test_the_drawing_is_turned_by_keys_and_by_dragging(chain: Chain, tab: Tab) -> None:
    drawn = "return document.getElementById('space').toDataURL().length"
    tab.until("it is drawn", lambda: tab.run(drawn) > 5000)
    before = tab.run("return [turn, tilt]")
    tab.driver.find_element("id", "space").send_keys(tab.KEY_LEFT)
    after = tab.run("return [turn, tilt]")
    assert after != before
    tab.run(
        "const c = document.getElementById('space'), e = (t, x) =>"
        " c.dispatchEvent(new PointerEvent(t, {pointerId: 1, clientX: x, clientY: 0}));"
        "c.setPointerCapture = () => {};"
        "e('pointerdown', 0); e('pointermove', 60); e('pointerup', 60)"
    )
    assert tab.run("return [turn, tilt]")[0] != after[0]


def test_depth_is_shown_in_colours(chain: Chain, tab: Tab) -> None:
    tab.click("wrist, depth")
    found = tab.until(
        "a depth picture",
        lambda: tab.run(
            "const v = shown.get('depth/wrist'); if (!v || !v.last) return null;"
            "const p = v.canvas.getContext('2d').getImageData(0, 0, 160, 120).data;"
            "const seen = new Set(); for (let i = 0; i < p.length; i += 4) seen.add(p[i] >> 4);"
            "return [v.caption.textContent, seen.size]"
        ),
    )
    assert " m (red: near)" in found[0]
    assert found[1] > 3


def test_home_goes_while_its_button_is_pressed(chain: Chain, tab: Tab) -> None:
    chain.activate_when_ready()
    chain.client.set_prompt("HARD: go up" if chain.height_m() < 0.42 else chain.down)
    chain.until("it moves", chain.moves)
    tab.click("Deactivate")
    tab.until("it stands", lambda: "stands" in tab.text("facts"))
    chain.wait_still()
    before = chain.measured().position_m
    tab.press("Home")
    chain.until("it moves", chain.moves)
    tab.let_go()
    chain.wait_still()
    tab.until("its word", lambda: "home" in tab.text("answer") or "let go" in tab.text("answer"))
    assert abs(chain.measured().position_m - before).max() > 0.001
    tab.press("Home")
    tab.until("home", lambda: tab.text("answer").startswith("home: reached"))
    tab.let_go()
    task = chain.client.task
    assert task is not None
    assert task.worker == "scripted"


def test_the_last_minutes_are_saved_on_a_touch(chain: Chain, tab: Tab) -> None:
    tab.click("Save the last minutes")
    tab.until("the log says so", lambda: "rolling: saved" in tab.text("events"))
