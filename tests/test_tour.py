"""`experiments.tour`: how long the search of one who knows the walls takes."""

import numpy as np
import pytest

from experiments.scoring import Task
from experiments.tour import CALL_SPACING, Tour
from sims.layouts import Layout

PLACE = 1.5
"""Full steps: a position counts as the nearest place of the layout's grid, at both ends."""


def room(width, height, *walls):
    return Layout("test", (width, height), np.array(walls, float).reshape(-1, 4), None)


def task(start, goal):
    return Task(0, np.array(goal, float), np.array(start, float))


def test_on_the_map_it_goes_straight_with_both_dimensions_at_once():
    everywhere = room(1000, 600).free_cells(40)
    tour = Tour(room(1000, 600), everywhere)
    assert tour.steps(task((100, 100), (900, 500))) == pytest.approx(80, abs=PLACE)
    assert tour.steps(task((500, 100), (500, 500))) == pytest.approx(40, abs=PLACE)


def test_around_a_wall_it_takes_the_way_through_the_gap():
    layout = room(1000, 600, (500, 0, 500, 500))
    tour = Tour(layout, layout.free_cells(40))
    # Up to the gap above the wall's end and down again; 500 mm up are more than 400 across.
    around = 2 * (500 + 20 - 100) / 10
    assert tour.steps(task((300, 100), (700, 100))) == pytest.approx(around, rel=0.15)


def test_off_the_map_it_calls_everywhere_before_it_can_miss_what_the_log_saw():
    """Down a corridor whose left end the log saw, from each place of the rest of it."""
    corridor = room(1200, 100)
    tour = Tour(corridor, np.stack([np.linspace(30, 200, 18), np.full(18, 50)], 1))
    starts = np.arange(300, 1170, 50)
    straight = (starts - 100) / 10
    steps = np.array([tour.steps(task((x, 50), (100, 50))) for x in starts])
    assert (straight - PLACE <= steps).all()
    assert (steps <= straight + 2 * (1200 - starts) / 10 + PLACE).all()
    assert (steps > straight + CALL_SPACING / 2).any()  # it can't know which way to turn


def test_what_no_way_leads_to_is_never_reached():
    layout = room(1000, 600, (500, 0, 500, 600))
    tour = Tour(layout, layout.free_cells(40)[:5])
    assert tour.steps(task((100, 100), (900, 100))) == np.inf
    assert tour.steps(task((900, 100), (100, 100))) == np.inf
