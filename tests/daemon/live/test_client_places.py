"""Test who gives way to a new client of the live view."""

from __future__ import annotations

from levid.daemon.live.client_places import ClientPlaces, Place, Rank


def test_the_longest_idle_of_the_lowest_rank_gives_way() -> None:
    gone: list[str] = []
    places = ClientPlaces(4)

    def enter(name: str, rank: Rank) -> Place:
        place = places.enter(lambda: gone.append(name))
        assert place is not None
        place.set_rank(rank)
        return place

    enter("asks", Rank.ASKS)
    enter("reads", Rank.READS)
    enter("waits long", Rank.WAITS)
    last = enter("waits", Rank.WAITS)
    enter("a", Rank.ASKS)
    assert gone == ["waits long"]
    last.leave()
    last.leave()
    enter("b", Rank.ASKS)
    assert gone == ["waits long"]
    enter("c", Rank.ASKS)
    assert gone == ["waits long", "reads"]


def test_requests_in_execution_never_give_way() -> None:
    places = ClientPlaces(2)
    for _ in range(2):
        place = places.enter(lambda: None)
        assert place is not None
        place.set_rank(Rank.ASKS)
    assert places.enter(lambda: None) is None
    assert len(places) == 2
    place.leave()
    assert places.enter(lambda: None) is not None
