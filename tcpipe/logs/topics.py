"""What a log says of itself: its topics, and what is damaged in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

MAX_DAMAGE = 1000
"""So many findings are told one by one."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a log, as its index tells; None where the index does not say.

    ``type_name`` is ``package/msg/Name`` for ROS 1 and ROS 2 alike; ``encoding`` is ``cdr``, ``ros1``, or what else the log names;
    ``definition`` is the definition text in the log ("" where it has none); ``problem`` says why the topic cannot be read.
    """

    name: str
    type_name: str
    message_count: int | None
    start_ns: int | None
    end_ns: int | None
    encoding: str
    definition: str
    problem: str | None = None
    silent_ns: int = 0
    """How long between the first and the last message there was none, as far as the index tells [ns]."""

    def joined(self, other: Topic) -> Topic:
        """Return this topic with the messages of ``other``, the same topic in another file."""
        counts = (self.message_count, other.message_count)
        starts = [stamp for stamp in (self.start_ns, other.start_ns) if stamp is not None]
        ends = [stamp for stamp in (self.end_ns, other.end_ns) if stamp is not None]
        return replace(
            self,
            message_count=None if counts[0] is None or counts[1] is None else counts[0] + counts[1],
            start_ns=min(starts, default=None),
            end_ns=max(ends, default=None),
            definition=self.definition or other.definition,
            problem=self.problem or other.problem,
            silent_ns=self.silent_ns + other.silent_ns,
        )


@dataclass(frozen=True, slots=True)
class Damage:
    """One thing that is wrong with a log: where (file and byte), on which topic, what, and what it cost where that is known.

    ``start_ns`` and ``end_ns`` bound the log times of what was lost, where known.
    """

    where: str
    what: str
    topic: str | None = None
    messages_lost: int | None = None
    bytes_lost: int | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def is_loss(self) -> bool:
        """Whether something is or may be lost; what is known to cost no message is only worth saying."""
        return self.messages_lost != 0 or bool(self.bytes_lost)

    def __str__(self) -> str:
        """Return one plain line."""
        topic = f", topic {self.topic}" if self.topic else ""
        lost = [
            f"{count} {unit}" for count, unit in ((self.messages_lost, "messages"), (self.bytes_lost, "bytes")) if count
        ]
        return f"{self.where}{topic}: {self.what}" + (f" ({', '.join(lost)} lost)" if lost else "")


def condensed(damage: Sequence[Damage]) -> list[Damage]:
    """Return the first thousand findings, and one that sums up the others: a log that is made to be broken has one for some bytes of it."""
    rest = damage[MAX_DAMAGE:]
    if not rest:
        return list(damage)
    lost = [
        sum(count or 0 for count in counts)
        for counts in zip(*((of.messages_lost, of.bytes_lost) for of in rest), strict=True)
    ]
    unknown = any(of.is_loss for of in rest) and not any(lost)
    what = f"{len(rest)} more findings like these"
    return [*damage[:MAX_DAMAGE], Damage(rest[0].where, what, None, None if unknown else lost[0], lost[1] or None)]


def normalized_type_name(name: str) -> str:
    """Return ``package/msg/Name`` for the ROS 1 form ``package/Name``; other forms stay as they are."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name
