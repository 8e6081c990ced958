"""The CPU rasterizer gives the same bits on any number of threads, in workers and from several threads at once."""

import threading

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from lerobot_msdyn.render import rasterize
from lerobot_msdyn.render.cpu.threads import begun, in_threads, threads


@pytest.fixture
def restore_threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def images_and_gradients(scene):
    raster, leaves = scene.render("cpu")
    (raster.features.square().sum() + raster.depth.sum() + raster.alpha.sin().sum()).backward()
    return [raster.features.detach(), raster.depth.detach(), raster.alpha.detach(), *(leaf.grad for leaf in leaves)]


def test_bits_do_not_depend_on_the_number_of_threads(make_scene, restore_threads):
    scene = make_scene(count=3000, width=200, height=140, views=2, channels=8)
    torch.set_num_threads(1)
    expected = images_and_gradients(scene)
    for count in (2, 3, 7):
        torch.set_num_threads(count)
        for _ in range(3):
            got = images_and_gradients(scene)
            assert all(torch.equal(a, b) for a, b in zip(got, expected, strict=True))


def test_two_python_threads_at_once(make_scene):
    scenes = [make_scene(count=1500, seed=seed) for seed in range(2)]
    expected = [images_and_gradients(scene) for scene in scenes]
    failures = []

    def work(index):
        for _ in range(10):
            got = images_and_gradients(scenes[index])
            if not all(torch.equal(a, b) for a, b in zip(got, expected[index], strict=True)):
                failures.append(index)

    running = [threading.Thread(target=work, args=(index,)) for index in range(2)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join(timeout=60)
        assert not thread.is_alive()
    assert failures == []


def test_what_no_helper_has_begun_is_made_by_the_thread_that_asks():
    go, by = threading.Event(), {}

    def made(item):
        by[item] = threading.current_thread()
        if item == 0:
            assert go.wait(60)
        return 10 * item

    first, second, third = begun(made, [0, 1, 2], 1)
    assert (third(), second()) == (20, 10)
    go.set()
    assert first() == 0
    assert by[1] is by[2] is threading.current_thread() is not by[0]


def test_an_error_of_a_helper_is_raised_where_its_result_is_asked_for():
    def failing(item):
        raise ValueError(item)

    (call,) = begun(failing, ["no"], 1)
    with pytest.raises(ValueError, match="no"):
        call()


class _Renders(Dataset):
    """Item i is the image of a Gaussian at i / 10 m to the right, and the gradient of its mean."""

    def __len__(self):
        return 4

    def __getitem__(self, index):
        means = torch.tensor([[index / 10, 0.0, 2.0]], requires_grad=True)
        raster = rasterize(
            means,
            torch.tensor([[1.0, 0, 0, 0]]),
            torch.full((1, 3), 0.2),
            torch.tensor([0.7]),
            torch.ones(1, 3),
            torch.eye(4)[None],
            torch.tensor([[60.0, 0, 40], [0, 60, 35], [0, 0, 1]])[None],
            80,
            70,
            backend="cpu",
        )
        raster.features.square().sum().backward()
        return raster.features.detach()[0], means.grad


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_data_loader_workers(method):
    data = _Renders()
    expected = [data[index] for index in range(len(data))]  # the parent has used its threads
    workers = 2 if method == "fork" else 1  # a spawned worker imports everything anew
    loader = DataLoader(data, batch_size=None, num_workers=workers, multiprocessing_context=method, timeout=120)
    for got, want in zip(loader, expected, strict=True):
        assert torch.equal(got[0], want[0])
        assert torch.equal(got[1], want[1])


@pytest.mark.parametrize("count", [1, 3])
def test_items_in_threads_come_in_their_order_and_few_ahead(count, restore_threads):
    torch.set_num_threads(count)
    taken = []

    def items():
        for item in range(20):
            taken.append(item)
            yield item

    def square(item):
        torch.randn(300, 300) @ torch.randn(300, 300)  # torch takes its number of threads when it first needs it
        assert (threads(), torch.get_num_threads()) == (1, 1)
        assert not torch.is_grad_enabled()
        return item * item

    with torch.no_grad():
        results = in_threads(square, items())
        assert [next(results) for _ in range(3)] == [0, 1, 4]
        assert len(taken) <= 3 + count
        assert list(results) == [item * item for item in range(3, 20)]
    torch.randn(300, 300) @ torch.randn(300, 300)
    assert torch.get_num_threads() == count


def test_fewer_items_at_once_have_more_threads_each(restore_threads):
    torch.set_num_threads(4)
    assert list(in_threads(lambda item: (item, threads()), range(3), at_once=2)) == [(0, 2), (1, 2), (2, 2)]
    assert list(in_threads(lambda item: (item, threads()), range(3), at_once=1)) == [(0, 4), (1, 4), (2, 4)]


def test_what_is_under_way_is_told_to_stop(restore_threads):
    torch.set_num_threads(2)
    stopped = threading.Event()

    def waits(item):
        if item == 0:
            raise ValueError("zero")
        assert stopped.wait(60)

    with pytest.raises(ValueError, match="zero"):
        list(in_threads(waits, range(10), stop=stopped.set))


def test_a_fault_in_a_thread_comes_out_and_ends_the_rest(restore_threads):
    torch.set_num_threads(2)

    def broken(item):
        if item == 3:
            raise ValueError("three")
        return item

    with pytest.raises(ValueError, match="three"):
        list(in_threads(broken, range(1000)))
