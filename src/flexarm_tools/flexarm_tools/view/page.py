# SPDX-License-Identifier: Apache-2.0
"""Shows the page with viser: a scene, plots, gains and buttons. No ROS: what the user does goes into a queue."""

import html
import queue
from collections import deque

import numpy as np

#: Colour of each state of the supervisor.
STATES = {
    "INACTIVE": "#6c757d",
    "READY": "#1c7ed6",
    "TRACKING": "#2b8a3e",
    "HOLDING": "#0c8599",
    "STOPPING": "#e67700",
    "FAULT": "#c92a2a",
}
COLOURS = ("#1c7ed6", "#e8590c", "#2b8a3e", "#ae3ec9", "#c92a2a", "#0c8599", "#e67700", "#495057")
BEAM, GHOST, TRAIL, TIP = (28, 126, 214), (173, 181, 189), (224, 49, 49), (224, 49, 49)
SLOW, FAST, HUB, PLAN = (247, 103, 7), (47, 158, 68), (52, 58, 64), (250, 176, 5)
#: Span of the plots [s], and how often they are drawn [Hz].
WINDOW, PLOT_RATE = 10.0, 6.0
#: A plot's axis has at least this length [mm; mm, mrad; N m]: zero is a line, not an axis from 0 to 100.
LEAST = {"tip": 0.2, "modes": 0.2, "torques": 0.2, "pair": 0.2}
#: Number of messages shown.
MESSAGES = 3
#: Largest factor of the deflections.
EXAGGERATION = 20.0


class History:
    """The last seconds of some numbers, in `columns` columns."""

    def __init__(self, columns):
        self._rows = deque()
        self._columns, self._session = columns, None

    def add(self, time, values, session=0):
        """Add a row; rows older than `WINDOW`, or of another session, are dropped."""
        if session != self._session or (self._rows and time < self._rows[-1][0]):
            self._rows.clear()
            self._session = session
        if not self._rows or time > self._rows[-1][0]:
            self._rows.append((time, *values))
        while self._rows[0][0] < time - WINDOW:
            self._rows.popleft()

    def columns(self):
        """Time before now [s], then the numbers: arrays of one length, two or more."""
        if len(self._rows) < 2:
            return (np.array([-WINDOW, 0.0]), *np.full((self._columns, 2), np.nan))
        table = np.array(self._rows).T
        return (table[0] - table[0, -1], *table[1:])


class Page:
    """The page of one arm.

    Parameters
    ----------
    arm : Arm
    reach : float
        Length of the arm [m].
    port : int
        On 127.0.0.1; another one if it is taken.
    link : str
        Address that opens the topics in Foxglove; empty: none.

    Attributes
    ----------
    done : queue.Queue
        What was done on the page: (name, arguments...).
    exaggeration : float
    """

    def __init__(self, arm, reach, port, link=""):
        import viser

        self.arm, self.reach = arm, reach
        self.done = queue.SimpleQueue()
        self.exaggeration, self.trail_shown = 1.0, True
        self.server = viser.ViserServer(
            "127.0.0.1", port, label=f"flexarm {arm.name}", verbose=False
        )
        self.url = f"http://127.0.0.1:{self.server.get_port()}"
        self._gains, self._plotted, self._spans = {}, 0.0, {}
        self._foxglove = link
        self._messages = deque(maxlen=MESSAGES)
        modes = len(arm.mode_names)
        self._histories = {
            "tip": History(1),
            "modes": History(modes),
            "torques": History(2 * len(arm.joints)),
        }
        self._make_scene()
        self._make_panel()

    # Scene -----------------------------------------------------------------------------------

    def _make_scene(self):
        scene, r = self.server.scene, self.reach
        flat = all(abs(j.axis[2]) > 0.99 and not any(j.origin_rpy) for j in self.arm.joints)
        self.server.gui.configure_theme(
            control_layout="fixed",
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(28, 126, 214),
        )
        eye = (0.3, -1.05, 1.05) if flat else (0.9, -1.5, 0.8)
        look = (0.35, 0.12, 0.0) if flat else (0.25, 0.0, 0.1)
        camera = self.server.initial_camera
        camera.position, camera.look_at = (tuple(r * np.array(v)) for v in (eye, look))
        scene.set_up_direction("+z")
        # Lines and dots in plain colours: no reflections to compute, and many machines have no GPU.
        scene.configure_environment_map(None)
        scene.add_grid(
            "/grid",
            width=4.0 * r,
            height=4.0 * r,
            cell_size=0.1 * r,
            section_size=0.5 * r,
            cell_color=(233, 236, 239),
            section_color=(206, 212, 218),
        )
        line = np.zeros((1, 2, 3))
        self._beam = scene.add_line_segments("/beam", line, BEAM, thickness=0.018 * r)
        self._ghost = scene.add_line_segments("/ghost", line, GHOST, thickness=0.006 * r)
        self._trail = scene.add_line_segments("/trail", line, TRAIL, thickness=0.005 * r)
        self._plan = scene.add_line_segments("/plan", line, PLAN, thickness=0.005 * r)
        self._plan.visible = False
        self._joints = self._dots("/joints", len(self.arm.joints), HUB, 0.036)
        self._tip = self._dots("/tip", 1, TIP, 0.03)
        self._slow = scene.add_line_segments("/slow", line, SLOW, thickness=0.014 * r)
        self._fast = scene.add_line_segments("/fast", line, FAST, thickness=0.014 * r)

    def _dots(self, name, count, colour, size):
        return self.server.scene.add_point_cloud(
            name,
            np.zeros((count, 3), np.float32),
            colour,
            point_size=size * self.reach,
            point_shape="circle",
            precision="float32",
        )

    def draw_plan(self, lines):
        """Draw the plan: the straight arm where the motion ends, and the tip's path to it, each (k, 3) [m]."""
        pieces = [segments(points) for points in lines if len(points) > 1]
        self._plan.visible = bool(pieces)
        if pieces:
            self._plan.points = np.concatenate(pieces)

    def _draw(self, picture, trail):
        self._beam.points = segments(picture.beam)
        self._ghost.points = segments(picture.ghost)
        self._trail.visible = self.trail_shown and len(trail) > 1
        if self._trail.visible:
            self._trail.points = segments(trail)
        # Points like the lines, so a slow browser draws both of the same instant.
        self._joints.points = picture.joints.astype(np.float32)
        self._tip.points = picture.tip[None].astype(np.float32)
        for handle, arrows in ((self._slow, picture.slow), (self._fast, picture.fast)):
            long = np.linalg.norm(arrows[:, 1] - arrows[:, 0], axis=1) > 1e-3 * self.reach
            handle.visible = bool(long.any())
            if handle.visible:
                handle.points = arrows[long].astype(np.float32)

    # Panel -----------------------------------------------------------------------------------

    def _make_panel(self):
        gui = self.server.gui
        self._head = gui.add_html(header("", "", "waiting for the nodes"))
        self._numbers = gui.add_html("")
        self._button("Stop", lambda: ("stop",), "red")
        self._button("Recover", lambda: ("recover",), "orange")
        self._message = gui.add_html("")
        with gui.add_folder("Move"):
            self._targets = [
                gui.add_slider(
                    joint.name,
                    *(round(v, 2) for v in reachable(joint)),
                    step=0.01,
                    initial_value=0.0,
                    hint="where the joint goes [rad]",
                )
                for joint in self.arm.joints
            ]
            self._duration = gui.add_slider(
                "duration", 0.5, 10.0, step=0.1, initial_value=2.0, hint="of the motion [s]"
            )
            self._button("Move there", lambda: ("move", self.target(), self._duration.value))
            self._button("Move back", lambda: ("back", self._duration.value), "gray")
            self._button(
                "With and without fast control",
                lambda: ("pair", self.target(), self._duration.value),
                "gray",
            )
            fast = gui.add_checkbox(
                "fast control", True, hint="off: slow control alone, the arm rings"
            )
            fast.on_update(self._by_hand(lambda: ("enable_fast", fast.value)))
        plots = gui.add_panel()
        self._tab_of_plots, self._pair = plots.add_tab("Plots"), None
        with self._tab_of_plots:
            self._plots = self._make_plots()
        plots.dock_left()
        plots.set_width(340)
        with gui.add_folder("Picture"):
            larger = gui.add_slider(
                "exaggerate",
                1.0,
                EXAGGERATION,
                step=0.5,
                initial_value=self.exaggeration,
                hint="deflections are drawn so many times as large",
            )
            larger.on_update(lambda _: self._look(larger.value, trail.value))
            trail = gui.add_checkbox("trail", True)
            trail.on_update(lambda _: self._look(larger.value, trail.value))
        self._folder = gui.add_folder("Gains")
        if self._foxglove:
            gui.add_html(
                f'<div style="margin:0.6em 0.8em;font-size:0.8em"><a id="foxglove" target="_blank" '
                f'href="{html.escape(self._foxglove)}">Open the topics in Foxglove</a></div>'
            )

    def _look(self, exaggeration, trail):
        if exaggeration != self.exaggeration:
            self.done.put(("clear_trail",))
        self.exaggeration, self.trail_shown = float(exaggeration), trail

    def _button(self, label, action, color=None):
        button = self.server.gui.add_button(label, color=color)
        button.on_click(lambda _: self.done.put(action()))

    def _by_hand(self, action):
        """A callback for changes by the user, not for those by the page itself."""

        def updated(event):
            if event.client is not None:
                self.done.put(action())

        return updated

    def _make_plots(self):
        joints, modes = self.arm.joint_names, self.arm.mode_names
        torques = [f"{joint} {kind}" for kind in ("slow", "fast") for joint in joints]
        return {
            "tip": self._plot("tip", "tip from the rigid arm's [mm]", ["error"]),
            "modes": self._plot("modes", "modal amplitudes [mm, mrad]", modes),
            "torques": self._plot("torques", "torques [N m]", torques, len(joints)),
        }

    def _plot(self, name, title, labels, solid=100, columns=None):
        """A plot of a history, or of given columns; lines from number `solid` on are dashed."""
        series = [{"label": "t"}]
        for i, label in enumerate(labels):
            line = {"label": label, "stroke": COLOURS[i % solid % len(COLOURS)], "width": 1.5}
            series.append(line | ({"dash": (4.0, 3.0)} if i >= solid else {}))
        columns, ends = columns or self._histories[name].columns(), (-WINDOW, 0.0)
        if name not in self._histories:
            ends = (0.0, float(columns[0][-1]))
        self._spans[name] = span(columns[1:], LEAST[name])
        plot = self.server.gui.add_uplot(
            columns,
            tuple(series),
            title=title,
            scales=scales(ends, self._spans[name]),
            axes=({"size": 26}, {"size": 46}),
            legend={"show": False},
            height=190,
        )
        if len(labels) > 1:
            self.server.gui.add_html(legend(labels, solid))
        return plot

    # What is shown ---------------------------------------------------------------------------

    def target(self):
        """Joint angles that the sliders give as target [rad]."""
        return [float(slider.value) for slider in self._targets]

    def aim(self, q):
        """Set the sliders of the target."""
        for slider, value in zip(self._targets, q, strict=True):
            slider.value = float(np.clip(round(value, 2), slider.min, slider.max))

    def say(self, text, bad):
        """Show a message to the user, above the last ones."""
        self._messages.appendleft((text, bad))
        lines = "".join(
            f'<div style="color:{"#c92a2a" if bad else "#495057"};opacity:{1.0 - 0.3 * i}">{html.escape(text)}</div>'
            for i, (text, bad) in enumerate(self._messages)
        )
        self._message.content = (
            '<div id="message" style="margin:0 0.8em 0.6em;font-size:0.8em;overflow-wrap:anywhere">'
            f"{lines}</div>"
        )

    def show(self, snapshot, picture, trail, tip_error):
        """Show a state.

        Parameters
        ----------
        snapshot : link.Snapshot
        picture : Picture
        trail : (k, 3) ndarray
        tip_error : float
            [m]
        """
        self._histories["tip"].add(snapshot.time, [1e3 * tip_error], snapshot.session)
        self._histories["modes"].add(snapshot.time, 1e3 * snapshot.delta, snapshot.session)
        self._histories["torques"].add(
            snapshot.time, (*snapshot.slow, *snapshot.fast), snapshot.session
        )
        with self.server.atomic():
            self._draw(picture, trail)
            put(self._head, header(snapshot.state, snapshot.reason))
            put(self._numbers, numbers(self.arm, snapshot, tip_error))

    def plot(self, now):
        """Draw the plots if they are due; `now` in seconds of any steady clock."""
        if now < self._plotted + 1.0 / PLOT_RATE:
            return
        self._plotted = now
        for name, plot in self._plots.items():
            plot.data = self._histories[name].columns()
            wanted = span(plot.data[1:], LEAST[name], self._spans[name])
            if wanted != self._spans[name]:
                self._spans[name] = wanted
                plot.scales = scales((-WINDOW, 0.0), wanted)

    def show_pair(self, curves):
        """Show the tip's error of two motions: name to time [s] and error [m], as `pair.Pair` keeps them."""
        if self._pair is not None:
            for handle in self._pair:
                handle.remove()
        names = list(curves)
        time = np.unique(np.concatenate([curves[name][0] for name in names]))
        columns = (time, *(1e3 * np.interp(time, *curves[name]) for name in names))
        with self._tab_of_plots:
            plot = self._plot(
                "pair", "the same motion twice: tip error [mm]", names, columns=columns
            )
            self._pair = (plot,)

    def silence(self, seconds):
        """Show that nothing has been received for this number of seconds."""
        text = (
            f"nothing received for {seconds:.0f} s" if seconds >= 2.0 else "waiting for the nodes"
        )
        put(self._head, header("", "", text))

    def offer_gains(self, found):
        """Make a slider for each `Gain`."""
        with self._folder:
            for gain in found:
                slider = self.server.gui.add_slider(
                    gain.label,
                    gain.low,
                    gain.high,
                    step=gain.step,
                    initial_value=gain.value,
                    hint=gain.hint,
                )
                slider.on_update(self._turned(gain, slider))
                self._gains[gain.name, gain.index] = slider
            if not found:
                self.server.gui.add_markdown("none: both laws are `none`")

    def _turned(self, gain, slider):
        return self._by_hand(lambda: ("turn", gain.name, gain.index, float(slider.value)))

    def take_values(self, values):
        """Show the present values of parameters, set here or by another program."""
        for name, value in values.items():
            for i, number in enumerate(value if isinstance(value, list) else [value]):
                slider = self._gains.get((name, i if isinstance(value, list) else None))
                if slider is None or slider.value == number:
                    continue
                slider.min, slider.max = min(slider.min, number), max(slider.max, number)
                slider.value = number

    def close(self):
        """End the server."""
        self.server.stop()


def put(handle, content):
    """Change an element if its content differs."""
    if handle.content != content:
        handle.content = content


def span(columns, least, now=None):
    """Ends of a plot's axis.

    Parameters
    ----------
    columns : sequence of ndarray
        What is drawn; NaN is not.
    least : float
        The axis is at least this long.
    now : (low, high), optional
        Ends that are kept while what is drawn fits, and covers more than a third of their distance.

    Returns
    -------
    (low, high)
        A tenth beyond what is drawn.
    """
    values = np.concatenate([np.ravel(column) for column in columns])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    size = max(high - low, least / 1.2)
    if now and now[0] <= low and high <= now[1] and now[1] - now[0] <= 3.0 * 1.2 * size:
        return now
    middle = 0.5 * (low + high)
    return middle - 0.6 * size, middle + 0.6 * size


def scales(x, y):
    """Both axes of a plot, for viser."""
    return {"x": {"time": False, "range": tuple(x)}, "y": {"range": tuple(y)}}


def segments(points):
    """A line through points (k, 3) as pairs of ends (k - 1, 2, 3)."""
    return np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)


def reachable(joint):
    """Range of a joint's slider [rad]."""
    low, high = joint.limits.position
    return (low, high) if np.isfinite(low) and np.isfinite(high) else (-np.pi, np.pi)


def legend(labels, solid):
    """Names of a plot's lines in their colours, as HTML."""
    words = "".join(
        f'<span style="color:{COLOURS[i % solid % len(COLOURS)]};margin-right:0.9em;white-space:nowrap">'
        f"{'┅' if i >= solid else '━'} {html.escape(label)}</span> "
        for i, label in enumerate(labels)
    )
    return f'<div style="font-size:0.75em;margin:0 0.8em 0.8em">{words}</div>'


def header(state, reason, other=""):
    """State of the supervisor and its reason, in its colour, as HTML."""
    colour = STATES.get(state, "#6c757d")
    return (
        f'<div style="margin:0.6em 0.8em;padding:0.5em 0.8em;border-radius:6px;background:{colour};color:white">'
        f'<b id="state" style="font-size:1.15em">{html.escape(state or other)}</b>'
        f'<div id="reason" style="font-size:0.8em;overflow-wrap:anywhere">{html.escape(reason)}</div></div>'
    )


def numbers(arm, snapshot, tip_error):
    """The state in numbers, as HTML."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{q:.3f}</td><td>{1e3 * (r - q):.2f}</td>"
        f"<td>{s:.2f}</td><td>{f:.2f}</td></tr>"
        for name, q, r, s, f in zip(
            arm.joint_names,
            snapshot.q,
            snapshot.reference,
            snapshot.slow,
            snapshot.fast,
            strict=True,
        )
    )
    saturated = ' <b style="color:#e67700">torque at its limit</b>' if snapshot.saturated else ""
    return (
        '<div style="margin:0 0.8em 0.4em;font-size:0.8em">'
        f'<span id="time">{snapshot.time:.2f}</span> s, motion <span id="trajectory">{snapshot.trajectory}</span>,'
        f' tip error <span id="tip">{1e3 * tip_error:.2f}</span> mm{saturated}'
        '<table id="joints" style="width:100%;text-align:right;font-variant-numeric:tabular-nums">'
        '<tr style="color:#868e96"><td></td><td>[rad]</td><td>error [mrad]</td><td>slow [N m]</td><td>fast</td></tr>'
        f"{rows}</table></div>"
    )
