# SPDX-License-Identifier: Apache-2.0
"""The watched cell: publication, unpacking and loading.

`unpacking` runs as a process of its own, so this page re-exports nothing. In the order of the flow:

    published     the cell as units and operators receive it
    unpacking     turns the zip of a cell's folder into a document and its meshes
    cell_loading  reads a new cell while the units keep reporting
"""
