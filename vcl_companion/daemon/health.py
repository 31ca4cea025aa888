"""How the service is: told to the autopilot, to systemd and to the log, when it changes."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager

from vcl_companion.daemon import notify
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import ServiceState
from vcl_companion.links.fusion import Fusion, FusionState
from vcl_companion.links.texts import Severity

_log = logging.getLogger(__name__)

_NUMBER = re.compile(r"\d+")

_CHECK_S = 0.5
# No frame answered for this long: the path from frame to pose is stalled.
_STALLED_S = 5.0
# Refused frames for this long are a state, not a hiccup.
_LOST_S = 1.0
# The same state for another reason is said again, but not more often than this.
_SAY_AGAIN_S = 5.0


class Health:
    """Follows the frames' outcomes; everything happens in the event loop's thread."""

    def __init__(self, autopilot: AutopilotLink, log: FlightLog) -> None:
        self._autopilot = autopilot
        self._log = log
        self._state = ServiceState.STARTING
        self._fusion = Fusion(FusionState.WAITING)
        self._said = ""
        self._text = "starting"
        self._said_at_s = float("-inf")
        self._last_answer_s: float | None = None
        self._last_fix_s: float | None = None

    @property
    def state(self) -> ServiceState:
        """How the service is, by its frames."""
        return self._state

    @property
    def text(self) -> str:
        """The same for people."""
        return self._text

    def localized(self, by_peers: bool = False) -> None:
        """Note that a frame gave a pose which was sent; ``by_peers``: it rests on them alone."""
        now_s = asyncio.get_running_loop().time()
        self._last_answer_s = self._last_fix_s = now_s
        text = "localized by peers alone" if by_peers else "localized"
        self._tell(ServiceState.ACTIVE, Severity.INFO, text, "found")

    def refused(self, reason: str) -> None:
        """Note that a frame gave no pose, and why."""
        now_s = asyncio.get_running_loop().time()
        self._last_answer_s = now_s
        if self._last_fix_s is None:
            self._tell(ServiceState.STANDBY, Severity.NOTICE, f"waiting: {reason}", "waiting")
        elif now_s - self._last_fix_s >= _LOST_S or self._state is ServiceState.CRITICAL:
            self._tell(ServiceState.CRITICAL, Severity.WARNING, f"lost: {reason}", "lost")

    @contextmanager
    def waiting_for_map(self) -> Iterator[None]:
        """Hold on while a frame waits for the first map: nothing is answered, and nothing hangs."""
        if self._state is ServiceState.STARTING:
            self._tell(ServiceState.STANDBY, Severity.INFO, "waiting for a map", "waiting")
        self._last_answer_s = None
        try:
            yield
        finally:
            self._last_answer_s = asyncio.get_running_loop().time()

    async def run(self) -> None:
        """Feed systemd's watchdog while frames are answered; fall silent when they are not."""
        while True:
            await asyncio.sleep(_CHECK_S)
            self._follow_fusion()
            if self._last_answer_s is None:
                notify.watchdog()  # no frame to answer: the camera's own errors end the service
                continue
            idle_s = asyncio.get_running_loop().time() - self._last_answer_s
            if idle_s < _STALLED_S:
                notify.watchdog()
            elif self._state is not ServiceState.STALLED:
                text = f"no frame was answered for {idle_s:.0f} s"
                self._tell(ServiceState.STALLED, Severity.ERROR, text, "stalled")

    def _tell(self, state: ServiceState, severity: Severity, text: str, event: str) -> None:
        """Say a new state at once, a new reason for the same one now and then."""
        now_s = asyncio.get_running_loop().time()
        self._text = text
        gist = _NUMBER.sub("#", text)  # "4 landmarks agree", "5 landmarks agree": one reason
        if state is self._state:
            if gist == self._said or now_s - self._said_at_s < _SAY_AGAIN_S:
                return
        else:
            self._state = state
            self._set_state()
        self._said, self._said_at_s = gist, now_s
        self._autopilot.say(severity, f"VCL {text}")
        self._log.event(event, text)
        notify.status(text)
        _log.log(logging.INFO if severity > Severity.WARNING else logging.WARNING, text)

    def _follow_fusion(self) -> None:
        """Say when the autopilot begins to use our poses, and when it does not any more.

        That nothing is sent the frames' own state has said.
        """
        before, self._fusion = self._fusion, self._autopilot.fusion()
        if before.state is self._fusion.state:
            return
        self._set_state()
        state, why = self._fusion.state, self._fusion.reason
        self._log.event("fusion", f"{state.value}: {why}" if why else state.value)
        if state is FusionState.FUSED:
            self._autopilot.announce(Severity.INFO, "VCL fused by the autopilot")
        elif state is FusionState.REJECTED or (
            before.state is FusionState.FUSED and state is not FusionState.LOST
        ):
            self._autopilot.announce(Severity.WARNING, f"VCL not fused: {why}")
        level = logging.WARNING if state is FusionState.REJECTED else logging.INFO
        _log.log(level, "the autopilot and our poses: %s%s", state.value, f", {why}" if why else "")

    def _set_state(self) -> None:
        """Say by the heartbeat how we are: what is not used is not what it should be."""
        is_refused = self._fusion.state is FusionState.REJECTED
        degraded = is_refused and self._state is ServiceState.ACTIVE
        self._autopilot.set_state(ServiceState.CRITICAL if degraded else self._state)
