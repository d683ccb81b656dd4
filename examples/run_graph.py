"""Run the nodes of a launch file in one program, frame by frame, with no process and no socket.

python examples/run_graph.py
"""

import sparseskin


def main() -> None:
    for ratio in (2, 4, 8):
        settings = [f"compressor.ratio={ratio}", "reconstructor.preset=paper"]
        quality = [
            sparseskin.psnr_db(frame.forces, frame.truth)
            for frame in sparseskin.run_launch("lift_box_40", 360, settings)
            if frame.truth.max() > 0.01  # newtons: an untouched skin is easy, and flatters
        ]
        mean = sum(quality) / len(quality)
        print(f"N/{ratio}: contact frames, mean PSNR {mean:.1f} dB, min {min(quality):.1f} dB")


if __name__ == "__main__":
    main()
