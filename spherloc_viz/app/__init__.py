"""The playground: a page in the browser where a problem is changed, solved and walked through.

``server`` starts everything; ``session`` is one browser client; every other file is one panel or one duty.
"""
