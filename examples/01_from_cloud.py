"""From the cloud of one view to ranked grasps: what the camera saw goes in, joints and poses come
out.
"""

from torchgrasp import ContactSpec, fit_shape, load_hand, load_object, plan_grasps

cloud = load_object(
    "rabbit"
).view  # your own: read_cloud("cloud.ply", viewpoint=(x, y, z)), in metres with z up
hand = load_hand("allegro")
spec = ContactSpec(friction=0.8, table=0.0)  # the object stands on the plane z = 0

shape = fit_shape(cloud, table=spec.table)
std = 1e3 * shape.predict(cloud.points).std_m.median()
print(f"the surface that the camera saw is known to {std:.1f} mm")

grasps = plan_grasps(cloud, hand, spec, starts=100, shape=shape)
executable = grasps.executable
for grasp in executable[:3]:
    print(
        f"success {float(grasp.success):.0%}, clearance {1e3 * float(grasp.clearance):.1f} mm, palm at"
    )
    print(grasp.obj_from_hand[0].numpy().round(3))
    print(
        {
            name: round(float(q), 3)
            for name, q in zip(hand.joint_names, grasp.joints[0], strict=True)
        }
    )
