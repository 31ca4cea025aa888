"""What this drone tells all others of itself, and when: map, sight of it, vote, team, epoch."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from vcl_companion.clock import Clock
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.localization.outlook import novelty_from, share_left
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.own_vote import OwnVote, Sight
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.wire.messages import MAX_TRACKED, MapState

_INTERVAL_S = 1.0
# Nothing new to tell: that we are there the heartbeats say.
_AT_REST_S = 2.0
# What is news is said again for so long at full pace: of many somebody missed it.
_NEWS_S = 4.5
# So much more or less of the map in sight is news.
_NEWS_SHARE = 0.1
# Who joins is told soon, and all who join meanwhile with it: a group starts at one time.
_TO_NEW_S = 0.2
# By then a vote has come to all.
_HEARD_S = 0.3


class OwnState:
    """Tells our state when there is news of it, and now and then.

    Args:
        group: whom it is told, and what of it is theirs.
        maps: what we fly on.
        estimator: where we are, and what we see of the map.
        sensor: of our camera.
        clock: time base of frames.
        log: told of teams, and why we vote for an update.
        options: when the map is to be updated.
        send: sends a message to a peer, or to all (0).
    """

    def __init__(
        self,
        group: Group,
        maps: MapStore,
        estimator: Estimator,
        sensor: Sensor,
        clock: Clock,
        log: FlightLog,
        options: UpdateOptions,
        send: Callable[[MapState, int], None],
    ) -> None:
        self._group = group
        self._maps = maps
        self._estimator = estimator
        self._clock = clock
        self._log = log
        self._send = send
        self._sensor = sensor
        self._vote = OwnVote(options, self._novelty_ahead_deg, self._share_ahead)
        self._wants_update = False
        self._wants_since_s = float("-inf")
        self.is_asked_for_update = False
        """Whether the ground wants the map updated: then so do we."""
        self._has_joined = False  # somebody, who has not been told our state since
        self._told_at_s = float("-inf")
        self._told_lead = (0, 0)
        self._news_until_s = float("-inf")

    @property
    def update_options(self) -> UpdateOptions:
        """What our vote goes by from the next look on."""
        return self._vote.options

    @update_options.setter
    def update_options(self, options: UpdateOptions) -> None:
        self._vote.options = options

    def joined(self) -> None:
        """Note that somebody came who does not know our state."""
        self._has_joined = True

    def poll(self, now_s: float) -> None:
        """Look at what we see, and tell our state if it is time."""
        interval_s = _TO_NEW_S if self._has_joined else self._interval_s(now_s)
        lead = self._group.team, self._group.leadership.own_epoch
        if lead[0] != self._told_lead[0]:
            self._log.event("team", f"of drone {lead[0]}" if lead[0] else "of all")
        is_due = now_s - self._told_at_s >= interval_s
        if self._voted(now_s) or lead != self._told_lead or is_due:
            self._told_at_s, self._told_lead = now_s, lead
            self._has_joined = False
            self.tell()

    def is_undecided(self, now_s: float) -> bool:
        """Return whether our vote may change by what is seen now, or was not heard of yet."""
        if self._wants_update:
            return now_s < self._wants_since_s + _HEARD_S
        return self._vote.is_open(now_s)

    def tell(self) -> None:
        """Tell our state at once."""
        stored, now_s = self._maps.current, asyncio.get_running_loop().time()
        state = MapState(
            stored.told_revision if stored else b"",
            stored.n_landmarks if stored else 0,
            self._estimator.is_localized(self._clock.now_ns()),
            min(self._estimator.in_sight.tracked, MAX_TRACKED),
            self._wants_update,
            self._group.team,
            self._group.leadership.epoch,
            world=stored.world if stored and stored.told_revision else b"",
            signature=self._group.signature_to_tell(now_s),
        )
        before = self._group.state_of(self._group.own_id)
        if before is None or state.is_news_after(before):
            self._news_until_s = now_s + _NEWS_S
        self._group.set_own_state(state)
        self._send(state, 0)

    def _voted(self, now_s: float) -> bool:
        """Look at what we see of the map; whether our vote for an update has changed."""
        stored = self._maps.current
        before = self._wants_update
        seen = self._estimator.in_sight
        revision = stored.revision if stored else b""
        group = self._group
        is_coming = group.maps.is_map_coming
        self._vote.follow(revision, group.maps.majority_wants_update, is_coming, now_s)
        if stored is not None and seen.seen_on != stored.revision:
            self._wants_update = self._vote.unseen()
            return self._wants_update != before
        if stored is None or not seen.is_being_sought(now_s):
            sigma_m = self._estimator.sigma_m if seen.tracked else None
            self._wants_update = self._vote.look(
                revision,
                Sight(seen.tracked, seen.covered, sigma_m, seen.novelty_deg),
                now_s,
            )
            if self._wants_update and not before:
                self._log.event(
                    "vote", f"the map is to be updated: {', '.join(self._vote.reasons)}"
                )
        self._wants_update |= self.is_asked_for_update and stored is not None
        if self._wants_update and not before:
            self._wants_since_s = now_s
        return self._wants_update != before

    def _novelty_ahead_deg(self, ahead_s: float) -> float | None:
        stored, there = self._maps.current, self._estimator.course(ahead_s)
        if stored is None or there is None:
            return None
        camera, mounting = self._sensor.camera, self._sensor.body_from_cam
        return novelty_from(stored.index.landmark_map, there @ mounting, camera)

    def _share_ahead(self, ahead_s: float) -> float | None:
        stored, estimator = self._maps.current, self._estimator
        here, there = estimator.course(0.0), estimator.turning_course(ahead_s)
        if stored is None or here is None or there is None:
            return None
        camera, mounting = self._sensor.camera, self._sensor.body_from_cam
        return share_left(stored.index.landmark_map, here @ mounting, there @ mounting, camera)

    def _interval_s(self, now_s: float) -> float:
        """How long after the last state the next one is told."""
        told = self._group.state_of(self._group.own_id)
        localized = self._estimator.is_localized(self._clock.now_ns())
        if told is None or told.localized != localized:
            return _INTERVAL_S
        change = abs(self._estimator.in_sight.tracked - told.tracked)
        interval_s = _INTERVAL_S * (1.0 if now_s < self._news_until_s else self._group.stretch)
        is_news = change > _NEWS_SHARE * max(told.tracked, 1)
        return interval_s if is_news else max(_AT_REST_S, interval_s)
