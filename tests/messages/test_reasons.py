"""Reasons why frames are not trusted: their text, and words of other versions."""

import re

import pytest
from bags import frame

from sparseskin.messages import Reason, Reconstruction, decode, encode
from sparseskin.messages.reasons import (
    OF_MEASUREMENTS,
    first_reason,
    phrase_of,
    sentence_of,
)


@pytest.mark.parametrize("reason", Reason)
def test_each_reason_has_a_clause_and_a_sentence(reason):
    assert re.fullmatch(r"[a-z][a-z ]+[a-z]", reason.phrase)
    assert re.fullmatch(r"[A-Z][a-z ,:]+[a-z]\.", reason.sentence)
    assert phrase_of(reason.value) == reason.phrase
    assert sentence_of(reason.value) == reason.sentence


def test_no_two_reasons_share_their_text():
    assert len({reason.phrase for reason in Reason}) == len(Reason)
    assert len({reason.sentence for reason in Reason}) == len(Reason)


@pytest.mark.parametrize("word", ["uniform", "new", *Reason])
def test_a_message_holds_any_reason_even_one_of_another_version(word):
    sent = Reconstruction(
        **frame(0)[-1].__dict__ | {"trusted": (False,), "reason": (word,)}
    )
    received = decode(*encode(sent.published("0" * 16, 0)))
    assert received.reason == (word,)


def test_the_text_of_an_unknown_reason_names_it():
    assert phrase_of("uniform") == 'unknown reason "uniform"'
    assert sentence_of("uniform") == 'Unknown reason "uniform".'


@pytest.mark.parametrize("of_readings", ["", *Reason])
@pytest.mark.parametrize("of_frame", ["", *Reason])
def test_a_frame_that_holds_nothing_says_so_and_else_the_sensor_comes_first(
    of_frame, of_readings
):
    reason = first_reason(of_frame, of_readings)
    if of_frame in OF_MEASUREMENTS or not of_readings:
        assert reason == of_frame
    else:
        assert reason == of_readings


def test_equal_repeated_and_clipped_measurements_show_as_they_are_received():
    assert set(OF_MEASUREMENTS) == {Reason.CONSTANT, Reason.FROZEN, Reason.CLIPPED}
