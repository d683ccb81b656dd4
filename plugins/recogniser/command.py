"""The command `sparseskin tasks`: models of the recogniser."""

import argparse
from pathlib import Path

from sparseskin.launch.commands.options import add_commands

from .models import READS, SUFFIX


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tasks`."""
    add = add_commands(
        parser, "Label what presses: models for a node of type recogniser."
    )
    make = add("train", _train, "train a model by recordings and labels")
    make.add_argument(
        "recordings",
        metavar="RECORDING",
        nargs="+",
        help="recording of any format",
    )
    about = "table, CSV: recording, label; and begin_s, end_s in it, if it has several labels"
    make.add_argument(
        "--labels",
        metavar="FILE",
        type=Path,
        required=True,
        help=about,
    )
    about = "file to write, a new one (default: %(default)s)"
    out = Path(f"model{SUFFIX}")
    make.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        default=out,
        help=about,
    )
    default = "(default: %(default)s; readings where there is none)"
    make.add_argument(
        "--reads",
        choices=READS,
        default=READS[0],
        help=f"what the node will read {default}",
    )


def _train(arguments: argparse.Namespace) -> int:
    """Train a model by frames of recordings and a table of their labels (extra tasks).

    It prints the share of frames that are recognised of rows of the table, or quarters of them,
    that were held out. The file is a joblib file, which is code: give it to nobody who does not
    trust you, and take none from others.
    """
    from sparseskin.nodes.errors import SettingsError
    from sparseskin.nodes.files import whole_file
    from sparseskin.studies.tasks.classifier import check_installed

    check_installed("tasks train")
    if arguments.out.suffix != SUFFIX:
        raise SettingsError(
            f"--out {arguments.out}: expected a name that ends in {SUFFIX}"
        )
    import joblib  # noqa: TID251  (it writes; models.py reads)

    from . import training

    spans = training.read_labels(arguments.labels)
    phi = training.phi_of(arguments.recordings, arguments.reads)
    examples = training.examples(arguments.recordings, spans, arguments.reads)
    with whole_file(arguments.out) as draft:
        model, share = training.train(examples, arguments.reads, phi)
        joblib.dump(model, draft)
        # A model that others can write would be refused: it is code.
        draft.chmod(0o600)

    counts = []
    for label in model.classes_:
        n_of_label = int((examples.labels == label).sum())
        counts.append(f"{label} {n_of_label}")
    n, n_inputs = examples.inputs.shape
    print(f"{n} frames of {n_inputs} numbers: {', '.join(counts)}")
    print(f"{100 * share:.0f} % of the frames held out are recognised")
    out = arguments.out
    print(f'{out}: written; use it: model = "{out}" of a node recogniser')
    return 0
