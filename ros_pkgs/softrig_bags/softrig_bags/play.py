"""From the player's command line to a finished replay."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from softrig_core.block.params import Declaration
from softrig_core.guard import say
from softrig_nodes.ros.messages import message_class

from .errors import BagError
from .player import CHANGES, CLOCK, LockstepPlayer, Player, Publishers, span
from .reader import BagReader
from .ros import Session
from .selection import Selection
from .topics import absolute
from .write import write_bag


def play(options: argparse.Namespace, ros_arguments: list[str], parameters: Sequence[tuple[Declaration, Any]]) -> int:
    """Play as the options of `cli.main_play` say; give the exit status.

    Parameters
    ----------
    parameters : sequence of (Declaration, value)
        The options as the node shows them.
    """
    selection = Selection.of(options.topics, options.regex, options.exclude)
    answers = [absolute(name) for name in options.lockstep]
    remap = dict(_remapping(text) for text in options.remap)
    with BagReader(options.bag) as bag:
        part = span(bag, options.start_offset, options.duration)
        chosen = [t for t in bag.topics if t.name in selection and t.name not in answers]
        chosen = [t for t in chosen if not (options.clock and t.name == CLOCK)]
        if answers:  # set, not said
            chosen = [t for t in chosen if t.name != CHANGES or CHANGES in selection.names]
        for name in [*selection.names, *remap]:
            if name not in [t.name for t in bag.topics]:
                raise BagError(f"no topic {name} in {options.bag}; it has {', '.join(t.name for t in bag.topics)}")
        coded = [t for t in chosen if t.wire not in ("cdr", "")]
        foreign = [t for t in chosen if t.name not in selection.names and t not in coded and not installed(t.msgtype)]
        for left, why in ((foreign, "their types are not installed here"), (coded, "their messages are no CDR")):
            if left:
                say(f"not played, {why}: {', '.join(f'{t.name} ({t.msgtype})' for t in left)}")
        chosen = [t for t in chosen if t not in foreign and t not in coded]
        hidden = [t.name for t in bag.topics if "/_" in t.name and t not in chosen]
        if hidden and not (selection.names or selection.regex or selection.exclude):
            say(f"not played, hidden: {', '.join(hidden)}; --topics plays them")
        if not chosen:
            raise BagError(f"none of the topics of {options.bag} is to be played")
        session = Session("player", ros_arguments, parameters)
        publishers = Publishers(session, bag, chosen, remap)
        if answers:
            lockstep = LockstepPlayer(
                session, bag, publishers, answers, remap, part, timeout=options.timeout, paused=options.paused
            )
            found = lockstep.run()
            counts = ", ".join(f"{len(t.data)} on {t.name}" for t in found.topics.values())
            print(f"{lockstep.sent} messages played, answered by {counts}")
            if options.answers:
                write_bag(options.answers, found)
            return 0
        player = Player(
            session,
            bag,
            publishers,
            part,
            rate=options.rate,
            loop=options.loop,
            clock=options.clock,
            paused=options.paused,
        )
        player.run(options.wait)
        print(f"{player.sent} messages played")
        return 0


def installed(msgtype: str) -> bool:
    """Whether messages of a type can be published here."""
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
