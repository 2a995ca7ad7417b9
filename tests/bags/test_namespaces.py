"""Rigs that were recorded together, each in its namespace: read, compared, exported and drawn one by one."""

import csv
import re

import pytest
from conftest import differences
from softrig_bags.cli import main_bag
from softrig_bags.content.topics import BagTopic
from softrig_bags.errors import BagError
from softrig_bags.files.bag import BagWriter
from softrig_bags.live.selection import Selection
from softrig_bags.read import read_bag, signals
from softrig_bags.write import write_bag
from softrig_bringup.cli import main
from test_bags import recording

GAINS = {"a": 1.0, "b": 2.0, "deep/c": 1.0, "ab": 3.0}  # "ab" begins with the name of another rig, "a"


@pytest.fixture
def bags(tmp_path):
    """A bag of four rigs and one without a namespace, in order of arrival; and a bag with a single rig."""
    writer = BagWriter(tmp_path / "together")
    messages = []
    for place, (name, gain) in enumerate([*GAINS.items(), ("", 5.0)]):
        for topic in recording(gain=gain).topics.values():
            full = "/".join(["", *filter(None, (name, topic.name.lstrip("/")))])
            number = writer.add_topic(BagTopic.known(full, topic.msgtype))
            messages += [(t + 1000 * place, number, data) for t, data in zip(topic.times, topic.data, strict=True)]
    for t, number, data in sorted(messages):
        writer.write(number, t, data)
    writer.close()
    write_bag(tmp_path / "own", recording())
    return tmp_path


@pytest.mark.parametrize("name", ["a", "/b", "deep/c/"])
def test_a_rig_in_a_namespace_is_read_as_if_it_were_alone(name, bags):
    alone, result = recording(gain=GAINS[name.strip("/")]), read_bag(bags / "together", name)
    assert list(result.topics) == list(alone.topics)
    assert [t.data for t in result.topics.values()] == [t.data for t in alone.topics.values()]
    named = signals(bags / "together", name)
    assert set(named) == set(signals(bags / "own"))
    assert differences(named.recording, result) == []  # also compares topics that are decoded only on access


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (("together", "together", "a", "deep/c"), 0),
        (("together", "together", "a", "b"), 1),
        (("together", "together", "ab", "a"), 1),
        (("own", "together", "/", "a"), 0),
        (("together", "own", "deep/c", "/"), 0),
        (("own", "together", "/", "b"), 1),
        (("own", "together", "/", "/"), 1),  # that bag has the topics of all five rigs
        (("together", "together", "b"), 0),
    ],
)
@pytest.mark.parametrize("how", [[], ["--align"]])
def test_rigs_of_one_bag_are_compared_with_each_other_and_with_another_bag(words, status, how, bags, capsys):
    a, b, *names = words
    command = [word for name in names for word in ("--namespace", name)]
    assert main(["bag", "compare", str(bags / a), str(bags / b), *command, *how]) == status
    printed = capsys.readouterr().out
    assert "plant/state" in printed
    assert ("c/plant" in printed) == (names == ["/", "/"])


def test_a_namespace_that_the_bag_does_not_have_is_refused_with_a_list(bags, capsys):
    for arguments, reported in (
        (["c"], "no topic in the namespace /c; expected one of /a, /b, /deep, /ab, /plant"),
        (["a b"], "'a b' is not the name of a namespace"),
        (["a", "b", "a"], "--namespace is expected once"),
    ):
        words = [word for name in arguments for word in ("--namespace", name)]
        assert main(["bag", "compare", str(bags / "together"), str(bags / "together"), *words]) == 2
        assert reported in capsys.readouterr().err
    assert main_bag(["export", str(bags / "together"), "--namespace", "a/b", "--format", "csv"]) == 2
    assert not (bags / "together_a_b_csv").exists()
    capsys.readouterr()


def test_a_rig_is_exported_without_its_namespace_and_every_message_of_the_bag_is_counted(bags, capsys):
    assert main_bag(["export", str(bags / "together"), "--namespace", "/b"]) == 0
    folder = bags / "together_b_csv"
    assert sorted(p.name for p in folder.iterdir()) == ["clock.csv", "command.csv", "plant.state.csv"]
    assert len(list(csv.reader((folder / "plant.state.csv").open()))) == 51
    metadata = bags / "together" / "metadata.yaml"
    metadata.write_text(
        re.sub(r"(name: /ab/command.*?message_count: )\d+", r"\g<1>99", metadata.read_text(), flags=re.S)
    )
    assert main_bag(["export", str(bags / "together"), "--namespace", "/b"]) == 1
    assert "/ab/command" in capsys.readouterr().err  # a topic of another rig in the same bag


def test_one_of_several_rigs_is_drawn_and_viewed(bags, monkeypatch, capsys):
    shown = []
    monkeypatch.setattr("softrig_bringup.view.serve.serve", lambda source, *_: shown.append(source))
    assert main(["view", str(bags / "together"), "--namespace", "a"]) == 0
    (source,) = shown
    assert {port.topic for m in source.rig.members for port in m.outputs} == {"plant/state", "command"}
    words = ["draw", "plot", str(bags / "together"), "plant/state/a/position", "--namespace", "b", "--format", "svg"]
    assert main([*words, "--out", str(bags / "pictures")]) == 0
    assert main([*words[:-4], "--namespace", "c"]) == 2
    assert "no topic in the namespace /c" in capsys.readouterr().err
    (bags / "pack").mkdir()
    (bags / "pack/pack.json").write_text("{}")  # a pack always has one rig, whatever its content
    assert main(["view", str(bags / "pack"), "--namespace", "a"]) == 2
    assert "leave out --namespace" in capsys.readouterr().err


def test_a_recorder_selects_the_topics_of_a_namespace_and_names_in_it():
    topics = ["/a/clock", "/a/plant/state", "/a/_hidden/x", "/ab/clock", "/clock", "/rosout", "/b/a/clock"]
    for chosen, result in (
        (Selection.of((), namespace="a"), ["/a/clock", "/a/plant/state"]),
        (Selection.of((), regex="state|rosout", namespace="/a/"), ["/a/plant/state"]),
        (Selection.of((), exclude="state", namespace="a"), ["/a/clock"]),
        (Selection.of(("clock", "/rosout"), namespace="a"), ["/a/clock", "/rosout"]),
        (Selection.of(()), [t for t in topics if "hidden" not in t]),
    ):
        assert [topic for topic in topics if topic in chosen] == result
    with pytest.raises(BagError, match="not the name of a namespace"):
        Selection.of((), namespace="1a")
