"""Write a run's recording as a bag: a function of the run alone, byte for byte."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path

from rosbags.interfaces import QosDurability
from softrig_core import Recording, RunError

from .content.topics import BagTopic, absolute, qos
from .errors import BagError
from .files.bag import BagWriter
from .files.compressed import plain
from .files.reader import BagReader


def write_bag(
    directory: Path | str,
    recording: Recording,
    *,
    storage: str = "mcap",
    compression: str = "none",
    custom_data: Mapping[str, str] | None = None,
    latched: Collection[str] = (),
) -> None:
    """Write a recording as a rosbag2 bag (metadata version 9), messages by time, equal times in topic order.

    The bag is written under a temporary name and moved into place, so it exists completely or not at all. Equal
    recordings produce equal bytes.

    Parameters
    ----------
    directory : Path or str
        The new bag; must not exist.
    storage : str
        ``mcap`` or ``sqlite3``.
    compression : str
        ``none`` or ``zstd`` (MCAP only).
    custom_data : mapping of str to str, optional
        Kept in the metadata, e.g. scenario, seed, versions.

    latched : collection of str
        Topics whose last message is also sent to later subscribers (transient local), such as robot_description.

    Raises
    ------
    BagError
        The directory exists, or storage or compression are unknown.
    RunError
        The disk is full or broken; nothing is left behind.
    """
    directory = Path(directory).absolute()
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise BagError(f"{directory} exists already; a bag is never overwritten")
    # The process number keeps two runs that write the same bag apart; the first to finish wins.
    temporary = directory.with_name(f".{directory.name}.{os.getpid()}.part")
    try:
        writer = BagWriter(
            temporary, storage=storage, compression=compression, custom_data=custom_data, name=directory.name
        )
        try:
            numbers = {}
            for topic in recording.topics.values():
                offered = qos(durability=QosDurability.TRANSIENT_LOCAL, depth=1) if topic.name in latched else qos()
                numbers[topic.name] = writer.add_topic(BagTopic.known(absolute(topic.name), topic.msgtype, [offered]))
            writer.write_recording(recording, numbers)
            writer.close()
        except BaseException:
            writer.abort()
            raise
        temporary.replace(directory)
    except OSError as error:
        raise RunError(f"bag {directory} not written: {error.strerror}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def retell(bag: Path, directory: Path, custom_data: Mapping[str, str]) -> None:
    """Write a bag again, with the same messages and other custom data.

    Parameters
    ----------
    bag : Path
        Stays as it is.
    directory : Path
        The new bag, of one file; must not exist.
    custom_data : mapping of str to str
        Kept in its metadata, in place of that of `bag`.

    Raises
    ------
    BagError
        `bag` cannot be read, or is not complete.
    """
    with BagReader(bag) as reader:
        storage = "mcap" if plain(reader.files[0]).suffix == ".mcap" else "sqlite3"
        writer = BagWriter(directory, storage=storage, custom_data=custom_data)
        try:
            numbers = [writer.add_topic(topic) for topic in reader.topics]
            for block in reader.blocks():
                for i in range(len(block)):
                    writer.write(numbers[int(block.topic[i])], int(block.t[i]), block.data(i))
            # The copy would claim to be whole, so it is not made of a bag that lacks messages.
            if not reader.is_whole:
                raise BagError(f"{bag} is incomplete; `softrig bag info {bag}` shows what is missing")
            writer.close()
        except BaseException:
            writer.abort()
            raise
