"""What commands share: the lines at the end of a run."""

from sparseskin.launch.commands.options import print_ends


def test_the_end_of_a_run_states_what_was_clipped_restarted_recorded_and_played(capsys):
    extremes = {"lowest": -0.5, "highest": 7.25, "f_min": -0.1, "f_max": 2.5, "unit": "N\x1b"}
    counts = {"clipped": 12, "clipped_below": 9, "clipped_above": 3}
    nodes = {
        "sensor": {"type": "sensor", **counts, **extremes},
        "flaky": {"type": "x:Y", "restarts": 2, "failures": ["exit code 1", "killed\x1b"]},
        "good": {"type": "sensor", "clipped": 0},
        "own": {"type": "mine:Sensor", "clipped": "some", "played": 3},
        "dead": {"type": "sensor"},
        "recorder": {
            "type": "recorder",
            "lost": {"/skin/taxels": 2, "/skin/truth": 1},
            "recording": {"out": "drag.mcap", "n_messages": 4803, "error": None},
        },
        "full": {
            "type": "recorder",
            "recording": {"out": "full.mcap", "n_messages": 7, "error": "full.mcap: no space"},
        },
        "silent": {
            "type": "recorder",
            "recording": {"out": "none.mcap", "n_messages": 0, "error": None},
        },
        "player": {"type": "player", "played": {"file": "drag.mcap", "frames": 1200}},
    }
    print_ends(nodes)
    assert capsys.readouterr().out.splitlines() == [
        r"sensor: readings clipped to the range: 3 above 2.5 N\x1b (highest 7.25), "
        r"9 below -0.1 N\x1b (lowest -0.5)",
        r"flaky: restarted 2 times after a failure; the last: killed\x1b",
        "drag.mcap: 4803 messages recorded, 3 dropped",
        "none.mcap: no message came, so there is no file",
        "drag.mcap: 1200 frames played",
    ]
