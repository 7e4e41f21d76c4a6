from setuptools import find_packages, setup

package_name = "st_recordings"

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_recordings"]),
        ("share/st_recordings", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="The single-track authors",
    maintainer_email="single-track@example.org",
    description="Recordings: readers of NCOM, CAN logs, MF4, bags and CSV; the MCAP writer and its recovery.",
    license="Apache-2.0",
)
