"""From the player's command line to a finished replay."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from softrig_core.block.params import Declaration
from softrig_core.guard import incomplete, print_line
from softrig_nodes.ros.messages import message_class

from ..content.topics import BagTopic, absolute
from ..errors import BagError
from ..files.reader import BagReader
from ..write import write_bag
from .player import CHANGES, CLOCK, LockstepPlayer, Player, Publishers, span
from .ros import Session, is_topic_name
from .selection import Selection


def play(options: argparse.Namespace, ros_arguments: list[str], parameters: Sequence[tuple[Declaration, Any]]) -> int:
    """Play a bag according to the options of `cli.main_play`; return the exit status.

    Parameters
    ----------
    parameters : sequence of (Declaration, value)
        The options as the node shows them.
    """
    selection = Selection.of(options.topics, options.regex, options.exclude)
    answers = [absolute(name) for name in options.lockstep]
    remap = dict(_remapping(text) for text in options.remap)
    with BagReader(options.bag) as bag:
        interval = span(bag, options.start_offset, options.duration)
        chosen = [t for t in bag.topics if t.name in selection and t.name not in answers]
        chosen = [t for t in chosen if not (options.clock and t.name == CLOCK)]
        # In lockstep these changes are set on the node by its parameter services, so they are not published too.
        if answers:
            chosen = [t for t in chosen if t.name != CHANGES or CHANGES in selection.names]
        for name in [*selection.names, *remap]:
            if name not in [t.name for t in bag.topics]:
                raise BagError(f"no topic {name} in {options.bag}; it has {', '.join(t.name for t in bag.topics)}")
        left: dict[str, list[BagTopic]] = {}
        types: dict[str, str] = {}  # type of each topic, by the name that is published
        for topic in chosen:
            live = remap.get(topic.name, topic.name)
            why = _obstacle(topic, live, topic.name in selection.names)
            if not why and types.setdefault(live, topic.msgtype) != topic.msgtype:
                why = f"{live} is played as {types[live]}"
            if why:
                left.setdefault(why, []).append(topic)
        for why, topics in left.items():
            print_line(f"not played, {why}: {', '.join(f'{t.name} ({t.msgtype})' for t in topics)}")
        chosen = [t for t in chosen if not any(t in topics for topics in left.values())]
        hidden = [t.name for t in bag.topics if "/_" in t.name and t not in chosen]
        if hidden and not (selection.names or selection.regex or selection.exclude):
            print_line(f"not played, hidden: {', '.join(hidden)}; --topics plays them")
        if not chosen:
            raise BagError(f"none of the topics of {options.bag} is to be played")
        session = Session("player", ros_arguments, parameters)
        publishers = Publishers(session, bag, chosen, remap)
        if answers:
            lockstep = LockstepPlayer(
                session, bag, publishers, answers, remap, interval, timeout=options.timeout, paused=options.paused
            )
            result = lockstep.run()
            counts = ", ".join(f"{len(t.data)} on {t.name}" for t in result.topics.values())
            _report_refused(options, publishers)
            print(f"{lockstep.sent} messages played, answered by {counts}")
            if options.answers:
                write_bag(options.answers, result)
            return 0
        player = Player(
            session,
            bag,
            publishers,
            interval,
            rate=options.rate,
            loop=options.loop,
            clock=options.clock,
            paused=options.paused,
        )
        player.run(options.wait)
        _report_refused(options, publishers)
        print(f"{player.sent} messages played")
        return 0


def _report_refused(options: argparse.Namespace, publishers: Publishers) -> None:
    for name, n in publishers.refused.items():
        incomplete(f"{options.bag}: {n} messages not played on {name}: ROS refuses their bytes, which are damaged")


def _obstacle(topic: BagTopic, live: str, named: bool) -> str:
    """Return why a topic cannot be published under a name; empty where it can."""
    if topic.wire not in ("cdr", ""):
        return "their messages are no CDR"
    if not named and not installed(topic.msgtype):
        return "their types are not installed here"
    return "" if is_topic_name(live) else "invalid names in ROS; rename them by --remap"


def installed(msgtype: str) -> bool:
    """Return whether messages of a type can be published here."""
    try:
        message_class(msgtype)
    except (ImportError, AttributeError):
        return False
    return True


def _remapping(text: str) -> tuple[str, str]:
    old, sign, new = text.partition(":=")
    if not (old and sign and new):
        raise BagError(f"--remap {text!r}: expected OLD:=NEW")
    return absolute(old), absolute(new)
