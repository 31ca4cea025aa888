"""How often a map is searched by who is lost."""

from __future__ import annotations

import asyncio

from tests.daemon import demo
from tests.daemon.test_companion import DRONE, OPTIONS, Shop
from tests.daemon.waiting import run
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.mailbox import Mailbox
from vcl_companion.daemon.map_search import MapSearch
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_filter import FilterOptions

TAKES_S = 0.15


class Searches:
    """A drone that is lost, whose searches take so long and are overtaken by newer frames."""

    def __init__(self) -> None:
        self.shop, self.maps, mailbox = Shop(), MapStore(""), Mailbox()
        self.work = MapWork(self.shop, forks=False)
        estimator = Estimator(FilterOptions(), OPTIONS.localization, lambda _: None)
        self.search = MapSearch(mailbox, self.maps, estimator, self.work)
        self.frame = demo.frame(DRONE)
        for one in (self.frame, demo.frame(DRONE, 1)):
            mailbox.put(one)

    def fly_on(self, *ids: int, is_known: bool) -> StoredMap:
        index = demo.map_index(*ids)
        return self.maps.replace(
            demo.encoded_map(*ids), index if is_known else demo.unrecognisable(index)
        )

    async def look(self, stored: StoredMap) -> tuple[Localized | NotLocalized, float]:
        """Search a map; return what that gave, and how long it is not searched again, s."""
        loop = asyncio.get_running_loop()
        assert self.search.is_due(stored, loop.time() + 10.0)
        attitude = demo.shot(DRONE).ned_from_body.rotation
        sought = self.search.begin(self.frame, attitude, stored, loop.time())
        self.shop.is_open.clear()
        loop.call_later(TAKES_S, self.shop.is_open.set)
        _, fix = await self.search.found(sought)
        self.search.end()
        ended_s = loop.time()
        pauses = (n / 100 for n in range(1000))
        return fix, next(s for s in pauses if self.search.is_due(stored, ended_s + s))


def test_a_map_that_does_not_show_where_we_are_is_searched_ever_more_rarely() -> None:
    async def scenario() -> None:
        lost = Searches()
        stored = lost.fly_on(1, 2, is_known=False)
        pauses = []
        for _ in range(5):
            fix, pause_s = await lost.look(stored)
            assert isinstance(fix, NotLocalized)
            pauses.append(pause_s)
        # No less than the search took, which is longer beside other load.
        assert pauses[0] >= TAKES_S
        assert pauses[1] >= min(2.0 * pauses[0], 1.0) - 0.03
        assert pauses[-1] >= 0.97
        # Another one is searched at once, and found in it we begin anew.
        known = lost.fly_on(1, 2, 3, is_known=True)
        fix, pause_s = await lost.look(known)
        assert isinstance(fix, Localized)
        assert pause_s == 0.0
        lost.work.end()

    run(scenario())
