"""Lessons: prose whose moments drive the live page. One Markdown file a lesson, see ``lesson``."""

from spherloc_viz.lessons.lesson import lesson_named, lessons

__all__ = ["lesson_named", "lessons"]
