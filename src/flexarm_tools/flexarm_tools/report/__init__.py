# SPDX-License-Identifier: Apache-2.0
"""``flexarm report``: shows recorded runs on one self-contained page of HTML.

``serialised`` turns many messages into columns of numbers at once, ``bag`` reads a bag of any length through
them into files of columns, ``timeline`` puts samples in order and on one axis of time, ``run`` joins the topics,
``analysis`` computes the numbers, ``animation`` the arm's shape, ``figures`` draws, ``page`` writes.
"""
