"""A page in the browser that shows a rig while it runs, or a run from its bag; knobs, buttons, pause and step."""
