# SPDX-License-Identifier: Apache-2.0
"""Tables and marks, JSON results, and all results as one page.

In the order of the flow:

    circumstances  time, machine and commit of a measurement
    report         tables and curves for people, marks, and one line of JSON for machines
    parts          each part of the report: its command, the question that it answers, its time limit
    plots          curves as plots
    page           all results as one page
"""
