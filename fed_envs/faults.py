"""Faults of one client; the message names the client."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from operator import length_hint


class ClientError(ValueError):
    """A fault of one client's environment or policy; the message names the client, and the round if there is one.

    :param clients: ids of the clients with the fault
    :param reason: what happened
    :param round: the communication round, counted from 1
    """

    def __init__(self, clients: Sequence[int], reason: str, round: int | None = None) -> None:
        self.clients, self.reason, self.round = list(clients), reason, round
        named = ", ".join(map(str, self.clients))
        where = "" if round is None else f", round {round}"
        super().__init__(f"client{'s' if len(self.clients) > 1 else ''} {named}{where}: {reason}")

    def in_round(self, round: int) -> ClientError:
        """The same fault with its round, unless it has one."""
        return self if self.round is not None else ClientError(self.clients, self.reason, round)

    def __reduce__(self) -> tuple[type[ClientError], tuple[list[int], str, int | None]]:
        return ClientError, (self.clients, self.reason, self.round)


class ContractError(ValueError):
    """An environment breaks Gymnasium's interface; the text continues after the name of its method."""


class RowError(Exception):
    """An exception, its ``__cause__``, of the environment in row ``row``."""

    def __init__(self, row: int) -> None:
        super().__init__(f"environment {row}")
        self.row = row


def run_rows(work: Callable[[Iterator[int]], None], rows: Sequence[int]) -> None:
    """Run ``work`` on an iterator of ``rows``.

    :raises RowError: if ``work`` raises
    """
    iterator = iter(rows)
    try:
        work(iterator)
    except Exception as error:
        # What is left of the iterator says which row was at work, at no cost for the rows before.
        raise RowError(rows[max(len(rows) - length_hint(iterator) - 1, 0)]) from error


def watched(work: Callable[[Iterator[int]], None]) -> Callable[[Iterator[int]], None]:
    """``work`` for an iterator that several threads share.

    :raises RowError: if ``work`` raises
    """

    def run(shared: Iterator[int]) -> None:
        row = -1

        def rows() -> Iterator[int]:
            nonlocal row
            for row in shared:  # noqa: UP028 (`yield from` would not leave the row behind)
                yield row

        try:
            work(rows())
        except Exception as error:
            raise RowError(row) from error

    return run
