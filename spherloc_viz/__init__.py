"""The screens of spherloc: viser app, rerun recorder, command line."""
