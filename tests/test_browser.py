"""In a browser: JupyterLab runs notebooks, sliders move figures. `python3 run.py test --browser` runs it.

Everything is asked of the figures' state (plotly's slider and traces, the explorer's picture as bytes), not of pixels.
"""

import json
import os
import shutil
import threading

import numpy as np
import pytest

import tapip3d_lite as t3d
from lessons.teaching import read_notebook
from lessons.widgets import PointPicker
from tests.notebook_tools import FOLDER, ROOT, jupyter_lab

BROWSERS = [
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge", "microsoft-edge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
]
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
ASKED = os.environ.get("TAPIP3D_BROWSER", "1")  # "08 10" for others than the usual three
CHOSEN = [next(FOLDER.glob(f"{number}_*.ipynb")) for number in ("00 03 04" if ASKED == "1" else ASKED).split()]
SECONDS = 600  # the longest that anything is waited for
ALL_SECONDS = 1800  # the longest that all notebooks together may take

pytestmark = [
    pytest.mark.skipif("TAPIP3D_BROWSER" not in os.environ, reason="run by `python3 run.py test --browser`"),
    pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome found: sliders are not tried in a browser"),
]

SETTINGS = {
    "notebook-extension/tracker": {"windowingMode": "none"},  # cells out of sight are drawn, too
    "apputils-extension/notification": {"fetchNews": "false", "checkForUpdates": False},
    "docmanager-extension/plugin": {"autosave": False},
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A JupyterLab on copies of the notebooks; gives its address with a place for a notebook's name."""
    home = tmp_path_factory.mktemp("lab")
    shutil.copytree(ROOT / "notebooks", home / "notebooks")
    shutil.copytree(ROOT / "data_samples", home / "data_samples")
    for name, values in SETTINGS.items():
        file = home / "config/lab/user-settings/@jupyterlab" / f"{name}.jupyterlab-settings"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(values))
    command = ["-m", "jupyterlab", f"--notebook-dir={home / 'notebooks'}", "--expose-app-in-browser", "--allow-root"]
    # One thread: those of torch and of WebGL drawn without a graphics card would wait for one another.
    with jupyter_lab(home, command, cwd=home, OMP_NUM_THREADS="1") as server:
        yield f"{server['url']}lab/tree/{{}}?reset&token={server['token']}"  # no tabs of before


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; `run.py test --browser` installs it")
    psutil = pytest.importorskip("psutil", reason="no psutil; `run.py test --browser` installs it")
    # WebGL without a graphics card.
    options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    # A page whose script never returns answers no time limit of its own.
    watch = threading.Timer(ALL_SECONDS, end_browser, [psutil.Process()])
    watch.daemon = True
    with playwright.sync_playwright() as play:
        running = play.chromium.launch(executable_path=BROWSER, args=options)
        watch.start()
        yield running
        watch.cancel()
        running.close()


def end_browser(tests):
    """Kill what the children of the tests (playwright's driver, JupyterLab) started: the browser and the kernels."""
    for child in tests.children():
        for started in child.children():
            started.kill()


@pytest.fixture
def page(browser):
    page = browser.new_page(viewport={"width": 1400, "height": 1000})
    page.set_default_timeout(1000 * SECONDS)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    yield page
    page.close()


RUN_ALL = """async seconds => {
    const panel = jupyterapp.shell.currentWidget
    const cells = () => Array.from(panel.content.widgets).filter(c => c.model.type === 'code')
    const prompts = () => cells().map(c => c.inputArea.promptNode.innerText).join(' ')
    const fail = reject => reject(`cells still run after ${seconds} s: ${prompts()}`)
    const late = new Promise((_, reject) => setTimeout(fail, 1000 * seconds, reject))
    const run = async () => {
        await panel.context.ready
        await panel.sessionContext.ready
        // What is asked while the kernel is still being connected may never be answered.
        const kernel = panel.sessionContext.session.kernel
        while (kernel.connectionStatus !== 'connected' || kernel.status !== 'idle')
            await new Promise(resolve => setTimeout(resolve, 100))
        await jupyterapp.commands.execute('notebook:run-all-cells')
    }
    await Promise.race([run(), late])
    return cells().map(c => [c.model.executionCount, c.model.outputs.toJSON().filter(o => o.output_type === 'error')])
}"""


@pytest.mark.parametrize("path", CHOSEN, ids=lambda p: p.stem)
def test_a_notebook_runs_and_its_figures_follow_their_controls(path, lab, page):
    page.goto(lab.format(path.name))
    page.wait_for_function("name => window.jupyterapp?.shell.currentWidget?.context?.path === name", arg=path.name)
    cells = page.evaluate(RUN_ALL, SECONDS)
    assert [number for number, _ in cells] == list(range(1, len(cells) + 1))
    assert not [errors for _, errors in cells if errors]

    source = "\n".join(cell["source"] for cell in read_notebook(path)["cells"] if cell["cell_type"] == "code")
    scenes, explorers = page.locator(".js-plotly-plot"), page.locator(".widget-vbox:has(> .widget-html img)")
    assert (scenes.count() > 0) == ("show_3d(" in source)
    assert explorers.count() == source.count("explore(")
    for i in range(scenes.count()):
        move_slider(page, scenes.nth(i))
    for i in range(explorers.count()):
        move_controls(page, explorers.nth(i))
    assert not page.problems
    page.evaluate("() => jupyterapp.shell.currentWidget.sessionContext.shutdown()")


SCENE = """g => {
    // Numbers of a frame that was not shown yet are still packed.
    const types = { f4: Float32Array, f8: Float64Array }
    const unpack = x => new types[x.dtype](Uint8Array.from(atob(x.bdata), c => c.charCodeAt()).buffer)
    const plain = x => Array.from(x.bdata ? unpack(x) : x)
    const frames = g._transitionData._frames
    const moving = frames[0].traces ?? frames[0].data.map((_, i) => i)
    return {
        active: g._fullLayout.sliders[0].active,
        shown: moving.map(i => plain(g._fullData[i].x)),
        frames: frames.map(frame => frame.data.map(trace => plain(trace.x))),
        eye: g._fullLayout.scene.camera.eye,
        aspect: g._fullLayout.scene._scene.glplot.getAspectratio(),
        // The box that is drawn, in the data's units.
        box: g._fullLayout.scene._scene.glplot.bounds.map(
            side => Array.from(side).map((x, i) => x / g._fullLayout.scene._scene.dataScale[i])),
    }
}"""


# Where the points of all frames of a scene of tracks lie in the drawn view, whose borders are -1 and 1; the farthest.
REACH = """g => {
    const [cloud, , heads] = g._fullData.map(trace => trace.name)
    if (cloud !== 'scene' || heads !== 'points') return null
    const unpack = x => Array.from(x.bdata ? new Float32Array(Uint8Array.from(atob(x.bdata), c => c.charCodeAt()).buffer) : x)
    const { model, view, projection } = g._fullLayout.scene._scene.glplot.cameraParams
    const times = (m, p) => [0, 1, 2, 3].map(i => p.reduce((sum, x, j) => sum + m[4 * j + i] * x, 0))
    const scale = g._fullLayout.scene._scene.dataScale
    let reach = 0, behind = false
    for (const frame of g._transitionData._frames)
        for (const k of [0, 2]) {
            const [x, y, z] = ['x', 'y', 'z'].map(axis => unpack(frame.data[k][axis]))
            for (let i = 0; i < x.length; i++) {
                const p = [x[i] * scale[0], y[i] * scale[1], z[i] * scale[2], 1]
                const q = times(projection, times(view, times(model, p)))
                behind ||= q[3] <= 0
                if (!Number.isNaN(q[0])) reach = Math.max(reach, Math.abs(q[0] / q[3]), Math.abs(q[1] / q[3]))
            }
        }
    return behind ? Infinity : reach
}"""


def move_slider(page, scene):
    """A scene of tracks opens on all that it shows; a click on the slider shows a frame's points and leaves the view alone."""
    scene.scroll_into_view_if_needed()
    reach = scene.evaluate(REACH)
    assert reach is None or 0.5 < reach < 1
    before = scene.evaluate(SCENE)
    last = len(before["frames"]) - 1
    assert last > 2 and before["shown"] == before["frames"][before["active"]]
    rail, wanted = scene.locator(".slider-rail-touch-rect").bounding_box(), round(0.7 * last)
    page.mouse.click(rail["x"] + wanted / last * rail["width"], rail["y"] + rail["height"] / 2)
    same = f"([g, points]) => JSON.stringify(({SCENE})(g).shown) === JSON.stringify(points)"
    until(page, same, [scene.element_handle(), before["frames"][wanted]])
    page.wait_for_timeout(500)  # the scene is drawn with its new points
    after = scene.evaluate(SCENE)
    assert after["active"] == wanted != before["active"]
    assert after["shown"] == after["frames"][wanted] != before["shown"]
    assert after["eye"] == before["eye"] and after["aspect"] == before["aspect"]  # what rests must not slide
    for one, other in zip(after["box"], before["box"], strict=True):
        assert one == pytest.approx(other, rel=1e-3)


# What an explorer shows: a digest of its picture's bytes, or why there is none.
SHOWN = """async explorer => {
    const [picture, refusal] = explorer.querySelectorAll(':scope > .widget-html')
    if (getComputedStyle(picture).display === 'none') return refusal.innerText
    const bytes = await (await fetch(picture.querySelector('img').src)).arrayBuffer()
    return new Uint8Array(await crypto.subtle.digest('SHA-256', bytes)).join()
}"""


def move_controls(page, explorer):
    """Every control takes its new value and changes what is shown; the old value brings the old picture back."""
    explorer.scroll_into_view_if_needed()
    handles, menus = explorer.locator(".noUi-handle"), explorer.locator("select")
    assert handles.count() + menus.count() > 0
    first = explorer.evaluate(SHOWN)
    for i in range(handles.count()):
        before, value = explorer.evaluate(SHOWN), float(handles.nth(i).get_attribute("aria-valuenow"))
        handles.nth(i).press("ArrowRight")
        changed(page, explorer, before)
        assert float(handles.nth(i).get_attribute("aria-valuenow")) > value
    for i in range(menus.count()):
        before = explorer.evaluate(SHOWN)
        menus.nth(i).select_option(index=1)
        changed(page, explorer, before)
        menus.nth(i).select_option(index=0)
    for i in range(handles.count()):
        handles.nth(i).press("ArrowLeft")
    until(page, f"async ([e, first]) => (await ({SHOWN})(e)) === first", [explorer.element_handle(), first])


def changed(page, explorer, before):
    until(page, f"async ([e, old]) => (await ({SHOWN})(e)) !== old", [explorer.element_handle(), before])


def until(page, condition, argument):
    """Ask a few times a second, which leaves the browser time to draw."""
    page.wait_for_function(condition, arg=argument, polling=200)


def test_a_click_on_the_picker_picks_a_point(page):
    """The picker's picture in a page of its own, where an input stands in for the text box of the widget."""
    clip = t3d.simulate_clip(seed=5, frames=2, size=(24, 36), tracks=6)
    picker = PointPicker(clip, width=360)
    picker.frame.value = 1
    box = f'<div class="pick-{id(picker)}"><input oninput="window.told = this.value"></div>'
    page.set_content(picker.children[1].value + box)
    for place in ((105, 45), (355, 5)):
        page.locator("img").click(position=dict(zip("xy", place, strict=True)))
    picker.text.value = page.evaluate("() => window.told")
    np.testing.assert_allclose(picker.pixels, [[1, 10, 4], [1, 35, 0]], atol=0.1)
    assert not page.problems
