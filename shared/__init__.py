# SPDX-License-Identifier: Apache-2.0
"""What edge units and the master agree on. It imports neither of them.

In the order of the flow:

    errors         the one tree of errors that the project raises
    text_files     text files as editors write them: tables, and YAML whose numbers are numbers
    configuration  YAML, environment and command line as one configuration
    files          files of which a power cut leaves all or nothing, and state in them
    clock          the only place that reads the time
    waiting        waiting with a limit, without losing a cancellation
    service        what the service manager that started this process is told
    transforms     rigid transforms `T_a_b` as (4, 4) matrices
    camera         pinhole intrinsics of a depth camera
    lattice        the voxel grid that the whole cell shares
    meshes         triangle meshes and their files
    urdf           a URDF file as plain joints and meshes
    joint_table    a robot as a flat table of moving joints, out of DH rows or a URDF
    kinematics     a robot's links at given joint positions (Algorithm 5)
    cell_file      `cell.yaml` as checked models, and the files that it names
    cell           the watched workspace: box, CAD, known objects, robot, board
    settings       what an operator may change while everything runs
    timebase       how far the master's clock is from a unit's
    messages       what units and master say to each other, as models
    wire           those messages as bytes
    discovery      how a master is found
"""
