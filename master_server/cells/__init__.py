# SPDX-License-Identifier: Apache-2.0
"""The watched cell as it comes in and goes out.

`unpacking` runs as a process of its own, so this page re-exports nothing. In the order of the flow:

    published     the cell as it is given to units and operators
    unpacking     a cell's folder as a zip becomes a document and its meshes
    cell_loading  a new cell is read while units go on
"""
