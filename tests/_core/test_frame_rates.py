"""Groups of recordings at the same frame rate."""

from torchpose._core.frame_rates import group_by_rate, same_rate


def test_rates_of_time_stamps_are_one_and_others_apart():
    rates = [30.3, 120.0, 29.98, 15.0, 30.0, 119.9]
    groups = group_by_rate(rates)
    assert groups == {15.0: [3], 30.0: [0, 2, 4], 119.95: [1, 5]}
    assert group_by_rate([]) == {}


def test_rates_near_the_usual_one_are_taken_for_it():
    """Also where rates to both sides of it lie farther apart than the members of a group may."""
    assert group_by_rate([28.7, 31.4, 30.0, 28.0], 30.0) == {28.0: [3], 30.0: [0, 1, 2]}


def test_same_rate():
    assert same_rate(30.0, 31.5) and same_rate(31.5, 30.0) and not same_rate(30.0, 32.0)
