"""Contacts that the watch for idle patches misses, and its false alarms; the rest is in small.

The table of the documents is computed at full size.
"""

import itertools

import numpy as np
import pytest
from bags import chain, skin_state

from sparseskin.messages import Contacts
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.rotation import RATIO, ROTATING
from sparseskin.nodes.reconstructor.idle import REFERENCE, REFRESH, IdleWatch
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.tiled import TiledScene

SKIN = Skin(64, 64, PAPER_F_MAX_N, pitch_m=0.005)
NOISE = NoiseModel.for_range(SKIN.f_max)
FRAMES = (1, 5, 15, 63)
"""Frames after the begin of a contact at which the missed ones are counted; the last one is just
before the solve that comes anyway."""


class Watched:
    """Patches under constant forces and noise, watched frame by frame."""

    def __init__(self, n_patches, truth):
        state = skin_state(
            **vars(SKIN), sigma_mid=NOISE.sigma_mid, sigma_end=NOISE.sigma_end
        )
        self._phis = CompressorSettings(rows=ROTATING, ratio=RATIO).phis(SKIN)
        self.watch = IdleWatch(n_patches, state, self._phis)
        self._rng = np.random.default_rng(0)
        self._n_patches, self._k = n_patches, 0
        for patch in range(n_patches):
            self.watch.solved(patch, truth)
        for _ in range((REFERENCE + 1) * len(self._phis)):
            self.frame(truth)

    def frame(self, truth):
        """True for each patch that would be solved, in the next frame under these forces."""
        phi = self._phis[self._k % len(self._phis)]
        self._k += 1
        readings = (
            NOISE.apply(truth, self._rng).reshape(-1) for _ in range(self._n_patches)
        )
        return self.watch.to_solve(
            phi.fingerprint, np.stack([phi.forward(r) for r in readings])
        )


def missed(contact, sigmas, n_patches):
    """Shares of contacts on an untouched patch that no frame has noticed after each of `FRAMES`;
    solves that come anyway are not counted.

    `contact` is the side of the touched square in taxels, `sigmas` the force of each touched taxel
    in standard deviations of an untouched one.
    """
    truth = np.zeros(SKIN.shape, np.float32)
    watched = Watched(n_patches, truth.copy())
    row, col = np.random.default_rng(0).integers(0, SKIN.n_rows - contact + 1, 2)
    truth[row : row + contact, col : col + contact] = sigmas * NOISE.sigma_end
    watched.watch._age[:] = -(2**62)  # none is due
    open_ = np.ones(n_patches, np.bool_)
    shares = []
    for k in range(1, max(FRAMES) + 1):
        open_ &= ~watched.frame(truth)
        shares += [float(open_.mean())] if k in FRAMES else []
    return shares


def test_strong_contacts_are_noticed_and_alarms_are_rare(full, note):
    n_patches, n_frames = (200, 640) if full else (20, 64)
    for contact in (4, 8, 16) if full else (8,):
        for sigmas in (1.0, 2.0, 3.0):
            shares = missed(contact, sigmas, n_patches)
            found = {
                f"{k} frames": f"{s:.1%}" for k, s in zip(FRAMES, shares, strict=True)
            }
            note(touched=f"{contact} x {contact}", sigmas=sigmas, **found)
            assert sigmas < 3 or contact < 8 or shares[-1] == 0
    press = TiledScene("hug", SKIN, 1).forces(2.2)[0]
    for name, truth in (("untouched", np.zeros_like(press)), ("pressed", press)):
        watched = Watched(16, truth)
        solved = [watched.frame(truth) for _ in range(REFRESH * (n_frames // REFRESH))]
        share = float(np.mean(solved)) - 1 / REFRESH  # without those solved anyway
        note(touched=f"false alarms, {name}", sigmas=f"{share:.2%}")
        assert share < 0.02


def noise():
    """Driver of an untouched skin with the noise of the paper."""
    rng, zero = np.random.default_rng(0), np.zeros((40, 40), np.float32)
    for k in itertools.count(1):
        yield k, NOISE.apply(zero, rng)


@pytest.mark.parametrize("stated", [NOISE.sigma_end, NOISE.sigma_end / 2, None])
@pytest.mark.parametrize("ratio", [3, 4, 8, 16])
def test_an_untouched_skin_has_no_contact(ratio, stated, full, note, tmp_path):
    skin = tmp_path / "skin.toml"
    of_noise = "" if stated is None else f"noise = {stated}\nnoise_mid = {stated}\n"
    skin.write_text(
        f"name = 'noisy'\nn_rows = 40\nn_cols = 40\nunit = 'N'\nf_max = 2.5\n{of_noise}"
    )
    source = {"source": f"{__name__}:noise", "skin": str(skin)}
    n_frames, n_starts = (8_400, 28) if full else (60, 1)
    begins = 0
    for seed in range(n_starts):
        compressor = {"ratio": ratio, "seed": seed}
        bus = chain(
            sensor=source, compressor=compressor, reconstructor={"contacts": True}
        )
        for messages in bus.frames(n_frames // n_starts):
            found = [one for one in messages if isinstance(one, Contacts)]
            begins += sum(
                name == "begin" for one in found for _, name in one.named_events
            )
        bus.check()
    note(
        untouched=f"N/{ratio}",
        sigmas=f"stated {stated}",
        begins=f"{begins} in {n_frames}",
    )
    assert not begins
