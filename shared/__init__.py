# SPDX-License-Identifier: Apache-2.0
"""Code that edge units, the master and readers share. It imports none of them.

In the order of the flow:

    errors         the tree of errors that the project raises
    text_files     text files as editors write them: tables, and YAML whose numbers are numbers
    configuration  YAML, environment and command line merged into one configuration
    files          atomic writes of files, and small state documents in files
    clock          the only place that reads the time
    waiting        waiting with a limit, without losing a cancellation
    service        sd_notify messages to the service manager of this process
    transforms     rigid transforms `T_a_b` as (4, 4) matrices
    camera         pinhole intrinsics of a depth camera
    lattice        the voxel grid that the whole cell shares
    meshes         triangle meshes and their files
    urdf           a URDF file as plain joints and meshes
    joint_table    a robot as a flat table of moving joints, built from DH rows or a URDF
    kinematics     a robot's links at given joint positions (Algorithm 5)
    cell_file      `cell.yaml` as checked models, and the paths of the files that it names
    cell           the watched workspace: box, CAD, known objects, robot, board
    settings       settings that an operator may change at run time
    timebase       offset between the master's clock and a unit's
    messages       messages between units, master, robot and operators, as models
    wire           encoding and decoding of these messages
    discovery      discovery of masters by multicast DNS
"""
