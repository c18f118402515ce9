# SPDX-License-Identifier: Apache-2.0
"""Figures for people and machines, and all of them as one page.

In the order of the flow:

    circumstances  when, on what machine and of which state of the source a figure was taken
    report         tables and curves for people, marks, and one line of JSON for machines
    parts          each part of the report: its command, the question that it answers, how long it may take
    plots          curves as pictures
    page           all results as one page
"""
