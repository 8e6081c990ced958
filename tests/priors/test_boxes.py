import numpy as np

from lerobot_msdyn.priors.boxes import box_about


def test_box_has_a_margin_within_the_picture():
    region = np.zeros((100, 200), bool)
    region[50:60, 5:9] = True
    assert box_about(region) == (slice(34, 76), slice(0, 25))


def test_box_has_its_least_size_where_the_picture_allows():
    region = np.zeros((100, 200), bool)
    region[50, 198] = True
    rows, columns = box_about(region, 64)
    assert rows.stop - rows.start == 64
    assert rows.start <= 50 < rows.stop
    assert columns == slice(136, 200)
    assert box_about(region, 120)[0] == slice(0, 100)


def test_box_about_nothing_is_empty():
    assert box_about(np.zeros((10, 10), bool)) == (slice(0, 0), slice(0, 0))
