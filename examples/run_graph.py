"""Run the nodes of a launch file in one program, frame by frame, with no process and no socket.

The paper's method (preset `paper`, its rows) at three ratios, beside the noisy reading of all
taxels.

python examples/run_graph.py
"""

import sparseskin


def main() -> None:
    for ratio in (2, 4, 8):
        paper = ["reconstructor.preset=paper", "compressor.rows=paper"]
        settings = [f"compressor.ratio={ratio}", *paper]
        frames = [
            frame
            for frame in sparseskin.run_launch("lift_box_40", 360, settings)
            if frame.truth.max()
            > 0.01  # newtons: an untouched skin is easy, and flatters
        ]
        noisy = [sparseskin.psnr_db(frame.taxels, frame.truth) for frame in frames]
        psnr_db = [sparseskin.psnr_db(frame.forces, frame.truth) for frame in frames]
        mean_db = sum(psnr_db) / len(psnr_db)
        noisy_db = sum(noisy) / len(noisy)
        print(
            f"N/{ratio}, preset paper: contact frames, mean PSNR {mean_db:.1f} dB, "
            f"all taxels {noisy_db:.1f} dB"
        )


if __name__ == "__main__":
    main()
