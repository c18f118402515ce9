# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept and found. It is imported before they are settled, and re-exports nothing.

In the order of the flow:

    kernel_state the state of the kernels' source, which names the folder of what is compiled from it
    prebuilt  compiled kernels that a release brings, for a named processor
    cache     the folder of compiled kernels, one for each state of their source
"""
