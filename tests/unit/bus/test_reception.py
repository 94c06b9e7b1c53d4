"""What arrives is compared with what the senders' statuses say they sent."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.bus.reception import SHARE, SLACK, WINDOW_S, Reception, Share
from vla_zenoh.keys import Keys
from vla_zenoh.types import NodeStatus

KEYS = Keys("panda")
IMAGES = KEYS.camera_jpeg("front")
STATUS_S, RATE_HZ = 0.5, 15.0


class Link:
    """A sender of images, and a reader that gets a share of them."""

    def __init__(self, expression: str = IMAGES) -> None:
        self.now_s, self.sent, self.started = 0.0, 0.0, 1
        self.arrived = {IMAGES: 0}
        self.reception = Reception(KEYS, lambda: self.now_s)
        self.reception.watch(expression, self.arrived)

    def run(self, seconds: float, share: float, rate_hz: float = RATE_HZ) -> None:
        for _ in range(round(seconds / STATUS_S)):
            self.now_s += STATUS_S
            before, self.sent = self.sent, self.sent + rate_hz * STATUS_S
            self.arrived[IMAGES] += round((int(self.sent) - int(before)) * share)
            rows = {KEYS.short(IMAGES): [rate_hz, 1e6, int(self.sent)]}
            detail = {"net": {"sent": rows}}
            status = NodeStatus("camera", "ok", "here", 1, self.started, detail=detail)
            self.reception.status_received(status)


def test_a_stream_of_which_nothing_arrives_is_short_within_four_seconds() -> None:
    link = Link()
    link.run(4.0, share=0.0)
    (why,) = link.reception.short().values()
    assert "camera/front/jpeg: 0 of " in why
    assert "vla-zenoh doctor" in why


def test_a_whole_stream_is_never_short() -> None:
    link = Link("vla/panda/**")
    for _ in range(20):
        link.run(1.0, share=1.0)
        assert not link.reception.short()
    ((key, share),) = link.reception.shares().items()
    assert key == IMAGES
    assert share.lost == 0


def test_a_stream_that_recovers_is_no_longer_short_and_its_loss_stays_counted() -> None:
    link = Link()
    link.run(5.0, share=0.0)
    assert link.reception.short()
    link.run(3.0, share=1.0)
    assert not link.reception.short()
    assert link.reception.shares()[IMAGES].lost > RATE_HZ


def test_a_sender_that_was_restarted_counts_anew() -> None:
    link = Link()
    link.run(5.0, share=1.0)
    link.sent, link.started = 0.0, 2
    link.run(5.0, share=1.0)
    assert not link.reception.short()
    assert link.reception.shares()[IMAGES].lost == 0


def test_a_sender_that_fell_silent_is_not_short() -> None:
    link = Link()
    link.run(5.0, share=0.0)
    link.now_s += 2 * WINDOW_S
    assert not link.reception.short()


def test_what_was_sent_before_the_subscription_is_not_missing() -> None:
    link = Link()
    link.reception.unwatch(link.arrived)
    link.run(5.0, share=0.0)
    link.reception.watch(IMAGES, link.arrived)
    link.run(5.0, share=1.0)
    assert not link.reception.short()
    assert link.reception.shares()[IMAGES].lost == 0


def test_what_others_put_in_a_status_does_no_harm() -> None:
    link = Link()
    for net in (
        None,
        3,
        {"sent": 3},
        {"sent": {"x": 3, "y": [1], "z": [1, 2, "3"], "": [1, 2, 3]}},
    ):
        link.reception.status_received(NodeStatus("a", "ok", "h", 1, 1, detail={"net": net}))
    assert not link.reception.short()


@given(rate_hz=st.floats(1.0, 60.0), share=st.sampled_from([0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0]))
def test_a_stream_is_short_when_less_than_the_share_arrives(rate_hz: float, share: float) -> None:
    link = Link()
    link.run(8.0, share, rate_hz)
    sent = rate_hz * WINDOW_S
    if sent * (1 - share) > SLACK + 2 and share < SHARE - 0.05:
        assert link.reception.short()
    if share >= 0.9:
        assert not link.reception.short()


def test_two_missing_samples_are_on_their_way() -> None:
    assert not Share(4, 2).below(1.0)
    assert Share(40, 36).below(0.95)
    assert not Share(40, 39).below(0.95)
