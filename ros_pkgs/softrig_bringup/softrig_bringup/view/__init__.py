"""A page in the browser that shows a running rig, or a run from its bag; with parameters, buttons, pause and step."""
