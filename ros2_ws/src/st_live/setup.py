from setuptools import find_packages, setup

package_name = "st_live"

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "passenger.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_live"]),
        ("share/st_live", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="The single-track authors",
    maintainer_email="single-track@example.org",
    description="The running suite: processes, supervision, replay, verification, relay and views.",
    license="Apache-2.0",
)
