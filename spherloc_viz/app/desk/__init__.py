"""The triage desk: all runs of a folder on one page, to be grouped, compared, labelled and sent."""
