"""Run the reference implementation of EMVA 1288 on a bench and print what it finds as JSON.

A program for the environment of validation/environments.py, not for optsim's: ``python reference.py
DESCRIPTOR``. The package is used as it is, through its public classes; its own log goes to standard error.
"""

from __future__ import annotations

import json
import sys

import emva1288
from emva1288.process import Data1288, LoadImageData, ParseEmvaDescriptorFile, Results1288


def main(descriptor: str) -> None:
    """Print the results of the bench that a descriptor file lists."""
    images = LoadImageData(ParseEmvaDescriptorFile(descriptor).images)
    statistics = Data1288(images.data).data
    found = Results1288(statistics)
    results = {
        "QE": found.QE / 100,
        "K_dn_e": found.K,
        "sigma_d_e": found.sigma_d,
        "PRNU": found.PRNU1288 / 100,
        "DSNU_e": found.DSNU1288,
        "capacity_e": found.u_e_sat,
        # Mean of the brightest pair: the package has no name for it, it is a point of its characteristic.
        "saturated_dn": statistics["temporal"]["u_y"][-1],
    }
    record = {
        "results": {name: float(value) for name, value in results.items()},
        "release": emva1288.__standard_version__,
        "levels": len(statistics["temporal"]["u_y"]),
    }
    json.dump(record, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
