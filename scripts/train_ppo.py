"""Train the paper's position controller with PPO, from Python: what ``cfb train target`` does, to copy and change.

    python scripts/train_ppo.py out/ppo [--config target] [--set KEY=VALUE ...] [--resume]

After an interruption, run it again with --resume. It ends with the same policy.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from cfb_mjx.runtime import configure_jax, environment


def main() -> None:
    """Train, and print a line at every checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="folder for policy.npz, curve.csv and the checkpoint")
    parser.add_argument("--config", default="target", help="a shipped training or a YAML file")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="changes to the configuration")
    parser.add_argument("--resume", action="store_true", help="continue from the checkpoint in the folder")
    arguments = parser.parse_args()
    configure_jax(x64=False)
    from cfb_mjx.train.config import load_config
    from cfb_mjx.train.run import Training, train

    config = replace(load_config(arguments.config, tuple(arguments.set)), algorithm="ppo")
    training = Training.prepare(config, versions=environment())

    def report(row: dict[str, float]) -> None:
        print(
            f"{row['commands'] / 1e6:7.1f} M commands {row['seconds']:6.0f} s   reward {row['reward']:.3f}   "
            f"hover {row['hover_mm']:7.1f} mm   command std {row['command_std']:.4f}",
            flush=True,
        )

    train(training, arguments.output, resume=arguments.resume, report=report)


if __name__ == "__main__":
    main()
