from setuptools import find_packages, setup

package_name = "st_offline"

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.jinja"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_offline"]),
        ("share/st_offline", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="The single-track authors",
    maintainer_email="single-track@example.org",
    description="Offline tools: checks, evaluation, identification, discovery, bands, reports.",
    license="Apache-2.0",
)
