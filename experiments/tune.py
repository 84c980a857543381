"""mmwave-loc tune: modes, a complete bank, or protection levels."""

from experiments.console.options import TUNING_SEED, require_alone
from experiments.console.options import TuneArgs as Args

OF_MODES = ("modes", "scenarios", "free", "diagonal")  # options that tune single modes


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.provenance import provenance
    from mmwave_env.io.files import require_writable, write_bytes, write_json

    if args.seed < TUNING_SEED:
        raise ValueError(f"seed: found {args.seed}, expected a tuning seed >= {TUNING_SEED}")
    if args.out:
        require_writable(args.out)
    require_alone(args, "bank", *OF_MODES)
    require_alone(args, "levels", "bank", "radio", "episodes", "evaluations", *OF_MODES)
    command = provenance("tune", args)["command"]
    if args.levels:
        from experiments.training.levels import trained_levels

        if args.out is None or args.out.suffix != ".safetensors":
            raise ValueError(f"out: found {args.out}, expected a name that ends with .safetensors")
        write_bytes(args.out, trained_levels(args.seed).to_bytes(command))
        return
    from experiments.training.tuning import tuned_bank, tuned_modes

    content = tuned_bank(args) if args.bank else tuned_modes(args)
    if args.out:
        write_json(args.out, {"command": command} | content)
