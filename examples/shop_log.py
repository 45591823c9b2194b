"""A made-up shop writes its log, shop.csv, which docs/logs.md learns from.

Each week a customer is in one of four segments and gets one of three offers; calls go to regular and gold customers
alone. A customer ends by leaving for good, or when the shop stops watching. Some weeks are lost from the log, and in
some the till forgot the profit.
"""

import csv

import numpy as np

SEGMENTS = ("sleeping", "new", "regular", "gold")  # from the worst to the best
OFFERS = {"nothing": 0.15, "mail": 0.35, "call": 0.55}  # the chance of going up a segment; else, as likely, down or not
COSTS = {"nothing": 0.0, "mail": 0.5, "call": 2.0}
SALES = {"sleeping": 0.0, "new": 2.0, "regular": 5.0, "gold": 9.0}  # a week
LEAVES = 0.2  # the chance that a sleeping customer leaves for good, each week
WEEKS = 40  # that a customer is watched
LOST = 0.02  # of all weeks
FORGOTTEN = 0.005  # of all profits


def offers_of(segment):
    return list(OFFERS) if segment in ("regular", "gold") else list(OFFERS)[:2]


def rows(n_customers=500, seed=0):
    """One row a week: customer, week, segment, offer, profit, left, unwatched."""
    rng = np.random.default_rng(seed)
    for customer in range(1, n_customers + 1):
        segment = "new"
        for week in range(1, WEEKS + 1):
            offer = str(rng.choice(offers_of(segment)))
            profit = SALES[segment] - COSTS[offer] + rng.integers(-1, 2)
            left = segment == "sleeping" and rng.random() < LEAVES
            if rng.random() >= LOST:
                shown = "" if rng.random() < FORGOTTEN else f"{profit:.2f}"
                unwatched = week == WEEKS and not left
                yield customer, week, segment, offer, shown, "yes" if left else "no", "yes" if unwatched else "no"
            if left:
                break
            up = rng.random() < OFFERS[offer]
            step = 1 if up else -int(rng.random() < 0.5)
            segment = SEGMENTS[min(max(SEGMENTS.index(segment) + step, 0), len(SEGMENTS) - 1)]


if __name__ == "__main__":
    with open("shop.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["customer", "week", "segment", "offer", "profit", "left", "unwatched"])
        writer.writerows(rows())
    with open("shop.csv") as file:
        lines = file.readlines()
    print("".join(lines[:5]) + f"... {len(lines) - 1:,} rows in shop.csv")
