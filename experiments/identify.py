"""``softwarp identify CASE``: find the physical parameters of a shipped example from its measurements.

    softwarp identify tentacle                          # modulus, base and marker from eight poses
    softwarp identify tentacle --method evolution --json tentacle.json
    softwarp identify tentacle --method gradient        # exact derivatives of equilibria, one candidate at a time
    softwarp identify tentacle --devices cuda:0 cuda:1  # candidates divided among GPUs
    softwarp identify segment                           # modulus and winding from three pressures
    softwarp identify segment --method gradient         # the same from exact derivatives
    softwarp identify beam --method gradient            # two loads at rest and ringing down, along gradients

The table has values with 95 % confidence intervals, and the error of measurements that were held out. How to fit a
robot of one's own: docs/identification.md.
"""

import argparse
import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softwarp import advice, checks
from softwarp.envs import registry
from softwarp.identification.fitting import METHODS, MOST_SAMPLES
from softwarp.io.atomic import prove_writable, write_text

CASES = {  # module of this folder with ``identify(extra, **options) -> Fit``
    "beam": "real_beam",
    "segment": "real_segment",
    "tentacle": "real_tentacle",
}
ON_DEVICES = ("tentacle",)  # cases whose ``identify`` takes ``devices``


def main(arguments: Sequence[str]) -> int:
    """Fit, print the table, write JSON; returns 1 if the fit did not converge."""
    parser = argparse.ArgumentParser(
        prog="softwarp identify",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("case", metavar="CASE", help=f"one of {', '.join(CASES)}")
    parser.add_argument("--method", default="least_squares", choices=METHODS, help="where to look (least_squares)")
    parser.add_argument("--samples", type=int, help="candidates tried before least squares begin")
    parser.add_argument("--seed", type=int, default=0, help="of samples and evolution")
    parser.add_argument("--json", metavar="FILE", help="write values, intervals and errors (-: print them)")
    parser.add_argument("--measured", type=Path, metavar="FILE.json", help="further measurements, to be predicted")
    parser.add_argument("--devices", nargs="+", metavar="DEVICE", help=f"that share the candidates of {ON_DEVICES[0]}")
    args = parser.parse_args(arguments)
    if args.case not in CASES:
        raise ValueError(f"there is no case {args.case!r}; {advice.nearest(args.case, CASES)}")
    if args.json and args.json != "-":
        prove_writable(args.json)
    options: dict[str, Any] = {"method": args.method, "seed": checks.seed(args.seed, "--seed")}
    if args.devices is not None:
        if args.case not in ON_DEVICES:
            raise ValueError(f"--devices: {args.case} settles on a CPU only; {', '.join(ON_DEVICES)} takes them")
        options["devices"] = [registry.check_device(device) for device in args.devices]
    if args.samples is not None:
        options["samples"] = checks.count(args.samples, "--samples", low=0, high=MOST_SAMPLES)
    found = importlib.import_module(f".{CASES[args.case]}", __package__).identify(args.measured, **options)
    text = json.dumps(found.as_dict(), indent=1)
    print(text if args.json == "-" else found.table())
    if args.json and args.json != "-":
        write_text(Path(args.json), text + "\n")
    return 0 if found.converged else 1
