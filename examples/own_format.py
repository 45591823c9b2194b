"""A file format of your own: what reads CSV files here is checked, cut and learnt from as the built-in formats are."""

from itertools import islice

import numpy as np

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.formats.format import readable

COLUMNS = {"s": int, "a": int, "r": float, "s_next": int, "a_next": int}


class CsvReader:
    """Lines ``s,a,r,s_next,a_next`` below a line with these names."""

    short = 0  # a line has all columns: none is shorter than the others

    def __init__(self, path):
        self.path = path

    def batches(self, rows, strict):
        with readable(self.path, "CSV file"), open(self.path) as file:
            names = next(file, "").strip().split(",")
            if names != list(COLUMNS):
                raise erl_torch.InputError("path", self.path, f"a CSV file whose first line is {','.join(COLUMNS)}")
            while lines := list(islice(file, rows)):
                table = np.loadtxt(lines, delimiter=",", dtype=list(COLUMNS.items()), ndmin=1)
                yield {name: table[name] for name in COLUMNS}


class Csv:
    """The format: which paths are of it, and what reads them."""

    def claims(self, path):
        return path.endswith(".csv")

    def reader(self, path, options):
        return CsvReader(path)


if __name__ == "__main__":
    mdp = WindyCliffEnv().mdp
    data = erl_torch.collect(mdp, 20, 1000, seed=1)
    columns = np.rec.fromarrays([getattr(data, name) for name in COLUMNS])
    np.savetxt("tuples.csv", columns, delimiter=",", fmt="%d,%d,%.17g,%d,%d", header=",".join(COLUMNS), comments="")

    read = erl_torch.read_experience("tuples.csv", 15, 4, chunk=1000, format=Csv())  # 1,000 tuples at a time
    print(f"tuples      {len(read):,}, the same: {read.checksum() == data.checksum()}")
    memory, disk = (erl_torch.CertaintyEquivalence(beta=10.0).fit(one, 15, 4).theta for one in (data, read))
    print(f"theta       {memory:.6f} from memory, {disk:.6f} from the file")

    with open("tuples.csv", "a") as opened:
        opened.write("99,0,-1,0,0\n")
    try:
        erl_torch.read_experience("tuples.csv", 15, 4, format=Csv())
    except erl_torch.InputError as error:
        print(f"refused     {error}")
