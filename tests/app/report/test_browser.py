"""The turning page in a headless browser, offline, driven by mouse and keys."""

import dataclasses
import io
import shutil
import time

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp.app.report.viewer import write_viewer

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
OPTIONS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
]
PATIENCE = 120_000
"""Longest wait for a picture [ms]: a busy machine draws without a GPU."""

pytestmark = [pytest.mark.browser, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]


@pytest.fixture(scope="module")
def path(run, tmp_path_factory):
    two = dataclasses.replace(
        run, grasps=run.grasps[torch.tensor([0, 0])], object_name="<b>jug</b>"
    )
    two.grasps.obj_from_hand[1, 0, 3] += 0.05
    return write_viewer(tmp_path_factory.mktemp("page") / "view.html", two)


@pytest.fixture(scope="module")
def browser():
    driver = pytest.importorskip("playwright.sync_api")
    with driver.sync_playwright() as play:
        opened = play.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        yield opened
        opened.close()


class Visit:
    """A page that was opened without a network, and what its console said."""

    def __init__(self, browser, address):
        self.context = browser.new_context(viewport={"width": 780, "height": 520}, offline=True)
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE)
        self.said = []
        self.asked = []
        self.page.on(
            "console",
            lambda message: self.said.append(message.text) if message.type == "error" else None,
        )
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)
        self.wait("Boolean(document.body.dataset.ready)")

    def state(self):
        return self.page.evaluate("({ ...document.body.dataset })")

    def wait(self, condition):
        """Wait until an expression is true; playwright's own way would evaluate text in the page,
        which refuses it.
        """
        end = time.monotonic() + PATIENCE / 1000
        while not self.page.evaluate(condition):
            assert time.monotonic() < end, condition
            self.page.wait_for_timeout(50)

    def picture(self):
        png = self.page.locator("#stage canvas").screenshot(timeout=PATIENCE)
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)

    def until_drawn(self):
        """Wait for the next frame: the page turns within it."""
        self.page.evaluate(
            "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )
        return self.picture()

    def middle(self):
        box = self.page.locator("#stage canvas").bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


@pytest.fixture(scope="module")
def visit(browser, path):
    opened = Visit(browser, path.as_uri())
    yield opened
    opened.context.close()


@pytest.fixture(autouse=True)
def calm(visit):
    """Begin each test with the first state and view; end it with a console that has said nothing."""
    visit.page.evaluate("location.hash = ''")
    visit.page.evaluate("document.activeElement.blur()")
    visit.page.click("#home")
    visit.page.locator("#grasps tbody tr").first.click()
    visit.page.get_by_role("button", name="grasp", exact=True).click()
    yield
    assert visit.said == [] and visit.page.locator("#errors").text_content() == ""


def differ(a, b):
    return float((np.abs(a - b).max(-1) > 30).mean())


def covered(picture):
    """The share of pixels that are not of the corner's colour."""
    return float((np.abs(picture - picture[0, 0]).max(-1) > 20).mean())


def test_the_page_is_whole_and_asks_for_nothing_else(visit):
    picture = visit.until_drawn()
    assert visit.asked[0].startswith("file://") and all(
        url.startswith(("file://", "data:")) for url in visit.asked
    )
    for name in ("legend", "sigma", "postures", "play", "tick", "plot", "grasps", "home"):
        assert visit.page.locator(f"#{name}").count() == 1
    assert (
        visit.page.locator("h1").text_content() == "Grasps of the <b>jug</b> with the allegro hand"
    )
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200 and covered(picture) > 0.1


def test_a_drag_turns_and_the_wheel_zooms(visit):
    first = visit.until_drawn()
    visit.page.mouse.move(*visit.middle())
    visit.page.mouse.down()
    x, y = visit.middle()
    visit.page.mouse.move(x + 120, y + 20, steps=4)
    visit.page.mouse.up()
    turned = visit.until_drawn()
    assert differ(first, turned) > 0.02
    visit.page.click("#home")
    assert differ(first, visit.until_drawn()) < 0.005
    visit.page.mouse.move(x, y)
    visit.page.mouse.wheel(0, 400)
    far = visit.until_drawn()
    visit.page.click("#home")
    visit.page.mouse.move(x, y)
    visit.page.mouse.wheel(0, -400)
    near = visit.until_drawn()
    assert covered(far) < covered(first) < covered(near)


def test_the_slider_of_the_shell_follows_mouse_and_keys(visit):
    visit.page.get_by_label("hand", exact=True).uncheck()
    visit.page.mouse.move(*visit.middle())
    visit.page.mouse.wheel(0, -400)
    first = visit.until_drawn()
    slider = visit.page.locator("#sigma")
    box = slider.bounding_box()
    slider.click(position={"x": box["width"] - 8, "y": box["height"] / 2})
    assert float(visit.state()["sigma"]) > 2.8 and differ(first, visit.until_drawn()) > 0.01
    for _ in range(3):
        slider.press("ArrowLeft")
    assert 2.3 < float(visit.state()["sigma"]) < 2.8 and visit.state()["grasp"] == "1"
    slider.press("Home")
    assert visit.state()["sigma"] == "0"
    visit.page.get_by_label("hand", exact=True).check()


def test_buttons_and_keys_choose_the_posture(visit):
    pictures = {"grasp": visit.until_drawn()}
    for key, name in (("1", "approach"), ("2", "pre-grasp"), ("3", "grasp")):
        visit.page.get_by_role("button", name=name, exact=True).click()
        assert visit.state()["posture"] == name
        pictures[name] = visit.until_drawn()
        visit.page.get_by_role("button", name="squeeze", exact=True).click()
        visit.page.keyboard.press(key)
        assert visit.state()["posture"] == name
    assert differ(pictures["approach"], pictures["grasp"]) > 0.02


def test_the_list_is_stepped_through_by_mouse_and_keys(visit):
    first = visit.until_drawn()
    visit.page.locator("#grasps tbody tr").nth(1).click()
    assert visit.state()["grasp"] == "2" and differ(first, visit.until_drawn()) > 0.01
    visit.page.keyboard.press("ArrowDown")
    assert visit.state()["grasp"] == "2"  # the last
    visit.page.keyboard.press("ArrowUp")
    assert (
        visit.state()["grasp"] == "1"
        and visit.page.locator("#grasps tr.on td").first.text_content() == "1"
    )


def test_layers_are_switched(visit):
    first = visit.until_drawn()
    box = visit.page.get_by_label("hand", exact=True)
    box.uncheck()
    assert covered(visit.until_drawn()) < covered(first)
    box.check()
    assert differ(first, visit.until_drawn()) < 0.005


def test_the_chosen_grasp_is_replayed_and_said_to_be_simulated_or_planned(visit):
    slider = visit.page.locator("#tick")
    said = visit.page.locator("#caption")
    slider.focus()
    slider.press("End")
    assert (
        visit.state()["tick"] == "4"
        and "Grasp 1 of 2, simulated on the true object: the end." in said.text_content()
    )
    visit.page.locator("#grasps tbody tr").nth(1).click()
    low = visit.until_drawn()
    slider.focus()
    slider.press("End")
    assert visit.state()["grasp"] == "2" and visit.state()["tick"] == "110"
    assert (
        "Grasp 2 of 2, its planned motion: lift. Only grasp 1 was simulated." in said.text_content()
    )
    assert differ(low, visit.until_drawn()) > 0.02
    slider.press("Home")
    assert "its planned motion: approach" in said.text_content()


def test_what_is_ticked_is_drawn_and_nothing_else(visit):
    slider = visit.page.locator("#tick")
    seen = set()
    for _ in range(2):
        boxes = visit.page.locator("#panel label:visible input[type=checkbox]:checked")
        for name in boxes.evaluate_all("all => all.map((x) => x.parentElement.textContent)"):
            if name == "contacts" and visit.state()["tick"]:
                continue  # this film has no forces
            box = visit.page.get_by_label(name, exact=True)
            first = visit.until_drawn()
            box.click()
            changed = (np.abs(first - visit.until_drawn()).max(-1) > 10).sum()
            assert changed > 20 and not box.is_checked(), (name, changed)
            seen.add(name)
            box.click()
        slider.focus()
        slider.press("End")
    assert seen == {
        "cloud",
        "surface",
        "hand",
        "contacts",
        "table",
        "axes",
        "camera",
        "true object",
    }
    assert not visit.page.get_by_label("shell", exact=True).is_checked()
    visit.page.get_by_label("shell", exact=True).check()
    assert visit.state()["sigma"] == "2"
    visit.page.get_by_label("shell", exact=True).uncheck()


ROWS = np.arange(30.0).reshape(10, 3) * [0.01, 0.02, 0.005]
"""Points whose box is 0.27 x 0.54 x 0.135 m."""


def ply(kind, order=""):
    head = f"ply\nformat {kind} 1.0\ncomment made\nelement vertex 10\nproperty uchar red\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "element face 0\n"
    head = (head + "property list uchar int vertex_indices\nend_header\n").encode()
    if kind == "ascii":
        return head + "".join(f"7 {x} {y} {z}\n" for x, y, z in ROWS).encode()
    rows = np.array([(7, tuple(row)) for row in ROWS], [("red", "u1"), ("point", f"{order}f4", 3)])
    return head + rows.tobytes()


def pcd(kind):
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z\nSIZE 4 8 8 8\nTYPE U F F F\nCOUNT 1 1 1 1\nWIDTH 10\nHEIGHT 1\n"
    head = (head + f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 10\nDATA {kind}\n").encode()
    if kind == "ascii":
        return head + "".join(f"7 {x} {y} {z}\n" for x, y, z in ROWS).encode()
    return (
        head
        + np.array(
            [(7, tuple(row)) for row in ROWS], [("rgb", "<u4"), ("point", "<f8", 3)]
        ).tobytes()
    )


def test_clouds_of_all_formats_are_opened_and_wrong_ones_are_told(visit):
    lines = [f"{x} {y} {z}" for x, y, z in ROWS]
    files = {
        "a.ply": ply("ascii"),
        "b.ply": ply("binary_little_endian", "<"),
        "c.ply": ply("binary_big_endian", ">"),
        "d.pcd": pcd("ascii"),
        "e.pcd": pcd("binary"),
        "f.xyz": "\n".join(lines).encode(),
        "g.pts": "\n".join(["10", *lines]).encode(),
        "h.csv": (
            "x,y,z,r\n" + "\n".join(line.replace(" ", ",") + ",1" for line in lines)
        ).encode(),
    }
    heard = visit.page.locator("#heard")
    for name, data in files.items():
        visit.page.evaluate("delete document.body.dataset.opened")
        visit.page.set_input_files("#open", {"name": name, "mimeType": "", "buffer": data})
        visit.wait("document.body.dataset.opened === '10'")
        assert f"{name}: 10 points, 0.270 x 0.540 x 0.135 m." in heard.text_content()
    assert visit.page.get_by_label("opened cloud", exact=True).is_checked()
    for name, data, said in (
        ("short.ply", files["b.ply"][:-9], "shorter than its header says"),
        ("packed.pcd", pcd("binary_compressed"), "save it as ascii or binary"),
        ("odd.png", b"\x89PNG\0\0", "neither .ply, .pcd nor text"),
        ("empty.xyz", b"hello\n", "no line has three numbers"),
    ):
        visit.page.set_input_files("#open", {"name": name, "mimeType": "", "buffer": data})
        visit.wait(f"document.getElementById('heard').textContent.startsWith('{name}')")
        assert said in heard.text_content()


def test_a_dropped_cloud_is_shown(visit):
    visit.page.get_by_label("hand", exact=True).uncheck()
    before = visit.until_drawn()
    visit.page.evaluate(
        """() => { const data = new DataTransfer();
        const points = Array.from({ length: 2000 }, (_, k) => `${Math.cos(k)} ${Math.sin(k)} 0.2`);
        data.items.add(new File([points.join("\\n")], "ring.xyz"));
        window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true })); }"""
    )
    visit.wait("document.body.dataset.opened === '2000'")
    assert "2.000 x 2.000 x 0.000 m" in visit.page.locator("#heard").text_content()
    assert differ(before, visit.until_drawn()) > 0.005
    visit.page.get_by_label("hand", exact=True).check()


def test_the_replay_moves_by_its_slider_and_plays_to_the_end(visit):
    slider = visit.page.locator("#tick")
    slider.focus()
    slider.press("Home")
    slider.press("ArrowRight")
    assert visit.state()["tick"] == "1"
    early = visit.until_drawn()
    slider.press("End")
    assert visit.state()["tick"] == "4" and differ(early, visit.until_drawn()) > 0.01
    assert slider.evaluate("x => x.parentElement.querySelector('output').value") == "1.00 s"
    slider.press("Home")
    visit.page.click("#play")
    visit.wait("document.body.dataset.tick === '4'")
    visit.wait("document.getElementById('play').textContent === 'play'")


def test_the_address_names_a_state_and_what_it_cannot_mean_is_told(browser, path):
    for state, expected in {
        "grasp=2": {"grasp": "2"},
        "sigma=3&tick=4": {"sigma": "3", "tick": "4"},
    }.items():
        other = Visit(browser, f"{path.as_uri()}#{state}")
        assert expected.items() <= other.state().items() and other.said == []
        other.context.close()
    wrong = Visit(browser, f"{path.as_uri()}#grasp=7&posture=fist")
    told = wrong.page.locator("#errors").text_content()
    assert "grasp=7" in told and "posture=fist" in told and wrong.state()["grasp"] == "1"
    wrong.context.close()
