"""Reasons for which a frame is not trusted, and their text wherever a person reads them."""

from enum import StrEnum
from typing import Self


class Reason(StrEnum):
    """Why a frame is not trusted. The value is the word of the field `reason` of a
    `Reconstruction`; `phrase` is a short clause, for counts and marks; `sentence` the meaning in
    full.
    """

    phrase: str
    sentence: str

    def __new__(cls, word: str, phrase: str, sentence: str) -> Self:
        # The value is the word alone: it travels, the texts do not.
        reason = str.__new__(cls, word)
        reason._value_ = word
        reason.phrase = phrase
        reason.sentence = sentence
        return reason

    CONSTANT = (
        "constant",
        "all measurements are equal",
        "The measurements hold no information: all are equal, on a skin with noise.",
    )
    FROZEN = (
        "frozen",
        "measurements repeat exactly",
        "The measurements repeat exactly, on a skin with noise.",
    )
    CLIPPED = (
        "clipped",
        "many readings or measurements are clipped",
        "Many readings are beyond the range of the skin, or many measurements share their largest "
        "or their smallest value: they are clipped, or of one sign alone.",
    )
    REST = (
        "rest",
        "the skin may not read zero at rest",
        "Nearly all taxels read a level far from zero at first, which may be their reading at "
        "rest.",
    )
    SIGN = (
        "sign",
        "readings fall below rest",
        "Readings fall below those at rest, and hardly rise: a press may lower them, or the "
        "baseline is wrong.",
    )
    MISSING = (
        "missing",
        "neighbouring readings are missing",
        "Readings are missing whose neighbours are missing, too.",
    )
    ERROR = (
        "error",
        "the estimated error is a large part of the forces",
        "The estimated error is a large part of the forces, as at first touch.",
    )
    WEAK = (
        "weak",
        "the forces are within the noise of the skin",
        "The estimated error is a large part of the forces, but both are within the noise of the "
        "skin.",
    )
    STUCK = (
        "stuck",
        "pressed taxels may be stuck",
        "Pressed taxels are without noise: they may be stuck.",
    )
    RANGE = (
        "range",
        "a force is beyond the range of the skin",
        "A force is beyond the range of the skin.",
    )


OF_MEASUREMENTS = (Reason.CONSTANT, Reason.FROZEN, Reason.CLIPPED)
"""Reasons that measurements show as they are received: they come before others."""


def first_reason(of_frame: str, of_readings: str) -> str:
    """The reason of a frame: `of_frame` is what its measurements and forces show, `of_readings`
    what the sensor states of its readings; "" if there is none.
    """
    if of_frame in OF_MEASUREMENTS:
        return of_frame
    return of_readings or of_frame


_REASONS = {reason.value: reason for reason in Reason}


def phrase_of(word: str) -> str:
    """Phrase of a reason; an unknown one, as in recordings of other versions, is named."""
    if word not in _REASONS:
        return f'unknown reason "{word}"'
    return _REASONS[word].phrase


def sentence_of(word: str) -> str:
    """Sentence of a reason; an unknown one is named, as by `phrase_of`."""
    if word not in _REASONS:
        return f'Unknown reason "{word}".'
    return _REASONS[word].sentence
