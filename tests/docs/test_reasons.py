"""Reasons why frames are not trusted, as the reference lists them."""

import re
from pathlib import Path

from sparseskin.messages import Reason

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"


def test_the_page_of_faults_has_the_sentence_of_each_reason():
    text = (
        (REFERENCE / "faults.md").read_text(encoding="utf-8").partition("## Reasons")[2]
    )
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE)
    assert rows == [(reason.value, reason.sentence) for reason in Reason]


def test_the_table_of_faults_has_each_reason_but_weak_and_no_other():
    text = (
        (REFERENCE / "faults.md").read_text(encoding="utf-8").partition("## Reasons")[0]
    )
    cells = [
        line.split(" | ")[2] for line in text.splitlines() if line.startswith("| ")
    ]
    words = set(re.findall(r"`(\w+)`", " ".join(cells)))
    # no fault: a contact that is not resolved
    assert words == set(Reason) - {Reason.WEAK}


def test_the_page_of_messages_lists_the_reasons():
    text = (REFERENCE / "messages.md").read_text(encoding="utf-8")
    (sentence,) = re.findall(r"is one word: (.*?) \(", text, re.DOTALL)
    assert re.findall(r"`(\w+)`", sentence) == list(Reason)
