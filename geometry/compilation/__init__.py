# SPDX-License-Identifier: Apache-2.0
"""The folder of compiled kernels. It is imported before the folder is chosen, and re-exports nothing.

In the order of the flow:

    kernel_state  digest of the kernels' source, which names the folder of their compiled code
    prebuilt      compiled kernels shipped with a release, for a named processor
    cache         choice of the folder of compiled kernels, one for each digest
"""
