BEGIN TRANSACTION;
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
INSERT INTO "facts" VALUES('configured','{}');
INSERT INTO "facts" VALUES('cell_file','"ac37d4597e9d683a5c4b0423f4009cea45b6a4595c98c2b3919038e0c0355021"');
INSERT INTO "facts" VALUES('last_id','1');
INSERT INTO "facts" VALUES('settings','{"voxel_size_m": 0.04, "occupancy_threshold": 0.6, "density_model": "pinhole", "density_rule": "neighbourhood", "own_share_min": 0.05, "support_area_max_m2": 0.0025, "support_points_min": 32, "margin_base_m": 0.03, "margin_noise_gain": 4.75, "stereo_subpixel_px": 0.12, "reference_margin_base_m": 0.03, "reference_spread_gain": 3.25, "edge_radius_px": 6, "static_padding_m": 0.05, "robot_padding_m": 0.05, "robot_depth_m": 0.15, "range_min_m": 0.0, "range_max_m": 10.0, "seen_block_size_m": 0.1, "seen_share_min": 0.9, "stale_after_s": 0.4, "robot_stale_after_s": 0.5, "joint_delay_s": 0.0}');
INSERT INTO "facts" VALUES('cell','{"name": "golden", "box_min_m": [0.0, 0.0, 0.0], "box_max_m": [1.0, 2.0, 0.5], "static": [{"name": "table", "mesh": "3773775f322e526a26903e57808ea2f35a123a471e9ede20be4bd94b38c2f039", "T_world_mesh": [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]}], "objects": [{"name": "crate", "mesh": "3773775f322e526a26903e57808ea2f35a123a471e9ede20be4bd94b38c2f039", "T_world_mesh": [[1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]}], "robot": {"name": "robot", "joint_names": ["shoulder", "elbow"], "T_world_base": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "motions": [{"kind": "revolute", "parent": -1, "T_parent_joint": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "axis": [0.0, 0.0, 1.0], "dof": 0, "multiplier": 1.0, "offset": 0.0}, {"kind": "revolute", "parent": 0, "T_parent_joint": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.1102230246251565e-16, -1.0, 0.0], [0.0, 1.0, 1.1102230246251565e-16, 0.2], [0.0, 0.0, 0.0, 1.0]], "axis": [0.0, 0.0, 1.0], "dof": 1, "multiplier": 1.0, "offset": 0.0}], "frames": [{"name": "base", "body": -1, "T_body_frame": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "mesh": null}, {"name": "link_1", "body": 0, "T_body_frame": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.1102230246251565e-16, -1.0, 0.0], [0.0, 1.0, 1.1102230246251565e-16, 0.2], [0.0, 0.0, 0.0, 1.0]], "mesh": "90ab090969d78cf1a0055decb0b20835515c540ec89164791e3cd3280ce8e23f"}, {"name": "link_2", "body": 1, "T_body_frame": [[1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "mesh": null}]}, "board": {"kind": "charuco", "columns": 5, "rows": 4, "square_m": 0.05, "marker_m": 0.037, "dictionary": "DICT_4X4_50", "first_marker": 0, "T_world_board": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]}}');
INSERT INTO "facts" VALUES('versions','{"settings": 2, "lattice": 2, "cell": 2, "pose": 0}');
CREATE TABLE meshes (sha256 TEXT PRIMARY KEY, data BLOB NOT NULL);
INSERT INTO "meshes" VALUES('90ab090969d78cf1a0055decb0b20835515c540ec89164791e3cd3280ce8e23f',X'43574D3101000000080000000C000000CDCC4CBDCDCC4CBDCDCC4CBDCDCC4CBDCDCC4CBDCDCC4C3DCDCC4CBDCDCC4C3DCDCC4CBDCDCC4CBDCDCC4C3DCDCC4C3DCDCC4C3DCDCC4CBDCDCC4CBDCDCC4C3DCDCC4CBDCDCC4C3DCDCC4C3DCDCC4C3DCDCC4CBDCDCC4C3DCDCC4C3DCDCC4C3D010000000300000000000000040000000100000000000000000000000300000002000000020000000400000000000000010000000700000003000000050000000100000004000000050000000700000001000000030000000700000002000000060000000400000002000000020000000700000006000000060000000500000004000000070000000500000006000000');
INSERT INTO "meshes" VALUES('3773775f322e526a26903e57808ea2f35a123a471e9ede20be4bd94b38c2f039',X'43574D3101000000080000000C000000CDCCCCBDCDCCCCBDCDCCCCBDCDCCCCBDCDCCCCBDCDCCCC3DCDCCCCBDCDCCCC3DCDCCCCBDCDCCCCBDCDCCCC3DCDCCCC3DCDCCCC3DCDCCCCBDCDCCCCBDCDCCCC3DCDCCCCBDCDCCCC3DCDCCCC3DCDCCCC3DCDCCCCBDCDCCCC3DCDCCCC3DCDCCCC3D010000000300000000000000040000000100000000000000000000000300000002000000020000000400000000000000010000000700000003000000050000000100000004000000050000000700000001000000030000000700000002000000060000000400000002000000020000000700000006000000060000000500000004000000070000000500000006000000');
CREATE TABLE units (
    id INTEGER PRIMARY KEY,
    ip TEXT NOT NULL UNIQUE,
    serial TEXT NOT NULL,
    model TEXT NOT NULL,
    software TEXT NOT NULL,
    boot_id TEXT NOT NULL,
    T_world_camera TEXT,
    pose_origin TEXT,
    pose_version INTEGER NOT NULL,
    note TEXT NOT NULL,
    pose_quality TEXT NOT NULL,
    intrinsics TEXT
);
INSERT INTO "units" VALUES(1,'10.0.0.1','233522071234','Intel RealSense D435','edge-unit 0.1.0','b2f1','[[0.9950041652780258, 0.09983341664682815, 1.222606741444822e-17, 0.5], [0.09983341664682815, -0.9950041652780258, -1.2185286661460182e-16, 1.0], [0.0, 1.2246467991473532e-16, -1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]','board',1,'','{"uncertainty_mm":1.5,"uncertainty_deg":0.04,"reprojection_px":0.3}','{"width":848,"height":480,"fx":425.0,"fy":425.0,"cx":423.5,"cy":239.5,"depth_scale_m":0.001,"stereo_baseline_m":0.05,"fx_stereo":null}');
COMMIT;
PRAGMA application_id=1129794899;
PRAGMA user_version=3;
