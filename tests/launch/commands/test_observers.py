"""The commands `monitor` and `record` beside a running graph."""

from types import SimpleNamespace

from sparseskin.launch.commands import observers


def test_patches_of_a_batch_are_those_of_the_settings_of_its_writer(monkeypatch):
    writers = {
        "/body/skin": "sensor",
        "/body/taxels": "sensor",
        "/body/reconstruction": "reconstructor",
        "/hand/taxels": "other",
    }
    graph = SimpleNamespace(writers=lambda: writers)
    asked = []

    def describe(_, node):
        asked.append(node)
        patches = {"key": "patches", "value": ("a", "b") if node == "reconstructor" else ()}
        return {"settings": [{"key": "seed", "value": 0}, patches]}

    monkeypatch.setattr(observers, "describe_node", describe)
    assert observers.batches_of(graph) == {"body": ["a", "b"]}
    assert asked == ["reconstructor", "other"]
    del writers["/body/taxels"], writers["/body/reconstruction"]
    assert observers.batches_of(graph) == {}
