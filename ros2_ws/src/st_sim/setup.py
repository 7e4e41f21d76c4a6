from setuptools import find_packages, setup

package_name = "st_sim"

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_sim"]),
        ("share/st_sim", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="The single-track authors",
    maintainer_email="single-track@example.org",
    description="The virtual Leaf: a simulated car and its sensors down to NCOM and CAN bytes.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "virtual_leaf = st_sim.run:main",
        ],
    },
)
