"""A middleware that the test steps: nothing happens in it but what a test does; calls of the node are recorded."""

from softrig_nodes.seam.middleware import Middleware, Peer, Reader


class Listening(Reader):
    """Passes messages on to functions."""

    def __init__(self, receive, matched=lambda count: None):
        self.receive, self.matched = receive, matched


class HandTimer:
    """A timer that records its last request: ns to its first call, period; None: cancelled."""

    def __init__(self, ns, call):
        self.call, self.asked = call, [(ns, 0)]

    def again(self, ns, period=0):
        self.asked.append((ns, period))

    def cancel(self):
        self.asked.append(None)

    @property
    def now(self):
        return self.asked[-1]


class Hand(Middleware):
    """The middleware of one node: `time` is the time of its clocks, ns."""

    def __init__(self, name="node", time=0):
        self.name, self.full_name, self.time = name, f"/{name}", time
        self.published, self.callbacks, self.matched = {}, {}, {}  # each by topic
        self.timers, self.posted, self.logs = [], [], []
        # the graph: publishers and subscribers by topic, types by topic, subscriptions by node
        self.writers, self.readers, self.types, self.reads = {}, {}, {}, {}

    def resolve(self, topic):
        topic = topic.replace("~", self.full_name)
        return topic if topic.startswith("/") else f"/{topic}"

    def publisher(self, topic, msgtype, matched):
        self.matched[topic] = matched
        return self.published.setdefault(topic, []).append

    def subscribe(self, topic, msgtype, reader):
        self.callbacks[topic], self.matched[topic] = reader.receive, reader.matched

    def be_prompt(self, place):
        self.place = place

    def post(self, call):
        self.posted.append(call)

    def timer(self, ns, callback):
        self.timers.append(HandTimer(ns, callback))
        return self.timers[-1]

    def now(self):
        return self.time

    def steady(self):
        return self.time / 1e9

    def publishers(self, topic):
        return [Peer(name, "/", "") for name in self.writers.get(topic, ())]

    def subscribers(self, topic):
        return [Peer(name, "/", kind) for name, kind in self.readers.get(topic, {}).items()]

    def subscriptions_of(self, peer):
        return self.reads.get(peer.name, [])

    def topics(self):
        return self.types

    def deaf(self):
        return ""

    def log(self, level, text):
        self.logs.append(f"{level.name} {text}")


class Kept:
    """A sink that keeps what was recorded."""

    def __init__(self):
        self.published = []

    def add(self, topic, t, data):
        self.published.append((topic, t, data))

    def note(self, t, data):
        self.published.append(("note", t, data))
