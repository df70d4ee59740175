"""A live view of the robot in a browser.

- `sources`: where a page gets its data: the server, measured topics, records for operators.
- `diagnostics`: health of modules, alarms, active limits, the list of events.
- `visualization`: 3-D scene, plots, and tables as HTML.
- `page`: one browser page, put together from these parts; the emergency stop and the strip below.
- `teleoperation`: a person leads the arm: sticks, keys, gamepads.
- `recordings`: playback of a recorded run.
- `tasks`: past tasks, their pictures and success rates.
- `web`: HTTP, access, and the server of all pages.
- `static`: styles, HTML and scripts as files.

`feature` starts the view in the server's process. `rn_view_attached`, which is the command
`roboneuron view`, and `rn_view_recorded`, its option `--run`, bring other sources.
"""
