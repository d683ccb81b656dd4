"""News of a graph, and requests to its nodes, as its launcher handles them."""

import json
from types import SimpleNamespace

import pytest
from played import NAMES

from sparseskin.launch.run.controls import NEWS_S, Controls
from sparseskin.launch.run.state import graph_description, graph_state
from sparseskin.nodes.process.control import ControlClient


@pytest.fixture
def desk(stage, tmp_path):
    """A graph that runs, its controls, and a client of theirs that watches."""
    played = stage()
    played.run()
    path = str(tmp_path / "graph.sock")
    controls = Controls(played.launch, played.fleet, path)
    client = ControlClient(path)

    def news():
        """What the client is sent by one look of the launcher."""
        played.fleet.serve()
        controls.serve()
        return client.receive()

    client.send({"watch": True})
    desk = SimpleNamespace(played=played, client=client, news=news)
    # It is accepted, then heard.
    news()
    news()
    yield desk
    client.close()
    controls.close()


def test_who_watches_is_sent_the_state_of_the_graph(desk):
    desk.played.now_s += NEWS_S
    (message,) = desk.news()
    assert message == {
        "graph": graph_state(desk.played.launch, desk.played.fleet, None)
    }
    assert [node["name"] for node in message["graph"]["nodes"]] == NAMES


def test_the_state_is_sent_twice_a_second(desk):
    began_s = desk.played.now_s
    times_s = []
    for k in range(1, 16):
        desk.played.now_s = began_s + k / 10
        if desk.news():
            times_s.append(k / 10)
    assert times_s == [0.5, 1.0, 1.5]


def test_another_condition_of_a_node_is_sent_at_once(desk):
    desk.played.now_s += NEWS_S
    desk.news()
    assert desk.news() == []
    desk.played.die("sensor")
    (message,) = desk.news()
    assert message["graph"]["nodes"][0]["condition"] == "failed"
    assert desk.news() == []


def test_a_node_answers_who_has_asked_and_its_new_state_is_sent_at_once(desk):
    desk.played.now_s += NEWS_S
    desk.news()
    asked = {"id": "7", "node": "sensor", "command": "pause", "value": True}
    desk.client.send(asked)
    assert desk.news() == []
    (command,) = desk.played.received("sensor")
    assert command["command"] == "pause"
    assert command["value"] is True
    answer = {"id": command["id"], "done": True, "text": "paused"}
    desk.played.says("sensor", "answer", settings={}, state={"paused": True}, **answer)
    answered, message = desk.news()
    assert answered["answer"] == {
        "id": "7",
        "node": "sensor",
        "done": True,
        "text": "paused",
    }
    assert message["graph"]["nodes"][0]["state"] == {"paused": True}


def test_a_node_that_is_late_is_answered_for(desk):
    desk.client.send({"id": "7", "node": "sensor", "command": "pause", "value": True})
    desk.news()
    desk.played.now_s += 20.1
    answered = desk.news()[0]["answer"]
    assert answered["id"] == "7"
    assert answered["done"] is False


def test_who_asks_is_sent_a_description_of_the_graph(desk):
    desk.client.send({"describe": "sensor"})
    (message,) = desk.news()
    launch = desk.played.launch
    described = graph_description(launch, desk.played.fleet, None, "sensor")
    assert message["description"] == json.loads(json.dumps(described))
